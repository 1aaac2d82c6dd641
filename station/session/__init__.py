"""The session, from an approval to a finished recording. Knows no socket and no screen.

`Session` is all that others may use; its state is read at `Session.store` and `Session.context`.
"""

from station.session.session import Session

__all__ = ["Session"]
