"""The operator's screen, a client of the daemon: `app.py` has keys and modes, `daemon_link.py` asks it."""
