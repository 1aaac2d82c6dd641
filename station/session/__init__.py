"""The session, from an approval to a finished recording, independent of sockets and screens.

Other packages use `Session` only, and read its state from `Session.store` and `Session.context`.
"""

from station.session.session import Session

__all__ = ["Session"]
