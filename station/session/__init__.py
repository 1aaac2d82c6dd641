"""The session: what the station does between a go and a sealed recording. Knows no socket and no screen."""

from station.session.session import Session

__all__ = ["Session"]
