"""The daemon's sockets for control and STOP, and the dispatch of verbs; used by `station.daemon` only."""
