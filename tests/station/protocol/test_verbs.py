"""The table of verbs: everything that follows from it does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from station.protocol.verbs import VERBS
from station.server.dispatch import CONNECTION, SessionDispatcher
from tests.station.session_rig import Rig

ROOT = Path(__file__).parents[3]


def test_the_protocols_page_is_fresh() -> None:
    page = subprocess.run(
        [sys.executable, ROOT / "docs" / "protocol.py"], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert page.stdout == (ROOT / "docs" / "protocol.md").read_text(), (
        "python docs/protocol.py > docs/protocol.md"
    )


async def test_every_verb_has_a_method(rig: Rig) -> None:
    assert SessionDispatcher(rig.session)._methods.keys() == VERBS.keys() - CONNECTION
