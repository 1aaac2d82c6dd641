"""The session, from an approval to a finished recording, independent of sockets and screens.

Other packages use `Session`, and read its state from `Session.store` and `Session.context`; the daemon also
asks for the `checklist` and works in `threads`.
"""

from station.session.session import Session

__all__ = ["Session"]
