"""The daemon's sockets: control, STOP, and the dispatch of verbs. For `station.daemon` alone."""
