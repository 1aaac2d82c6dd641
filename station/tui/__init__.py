"""The operator's screen, a client of the daemon: `app.py` has keys and modes, `desk.py` asks the daemon."""
