"""Procedures with a person: capture, drift check, touch test, acceptance of an arm, a new cell.

They depend on the daemon's protocol only. Shell and screen each pass in a callable or small object by which
the person is asked.
"""
