"""Programs as text: they arrive in pieces, end in column 0, and say what they are."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from station.simulation.controller.uploads import UploadReader

SCRIPT = """def rtde_control():
  global reg_offset_float = # float register offset
0
  global reg_offset_int = # int register offset
24
  def exec_move_path():
    signal_async_progress(0)
    movej([0.1,-1,1,-1,-1,0],a=1.4,v=1.05,r=0)
    signal_async_progress(1)
    movel(p[0.3,-0.2,0.4,0,3.14,0],a=0.5,v=0.1,r=0.01)
  end
  if True:
    end_of_nothing = 1
  end
end
"""


@given(cuts=st.lists(st.integers(1, 90), max_size=30))
def test_programs_are_found_in_any_segmentation(cuts: list[int]) -> None:
    stream = (SCRIPT + "stopj(2.0)\nsec note():\n  textmsg(1)\nend\n# a comment\n\n").encode()
    reader, seen = UploadReader(), []
    for cut in [*cuts, len(stream)]:
        seen += reader.feed(stream[:cut])
        stream = stream[cut:]
    assert [u.name for u in seen] == ["rtde_control", "", "note"]
    assert seen[0].text == SCRIPT and seen[1].text == "stopj(2.0)"
