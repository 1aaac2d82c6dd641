"""The table of verbs: everything that follows from it does."""

from __future__ import annotations

from station.protocol.verbs import VERBS
from station.server.dispatch import CONNECTION, SessionDispatcher
from tests.station.session_rig import Rig


async def test_every_verb_has_a_method(rig: Rig) -> None:
    assert SessionDispatcher(rig.session)._methods.keys() == VERBS.keys() - CONNECTION
