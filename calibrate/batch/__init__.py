"""Many recordings, solved in a process pool or on a cluster, and their trends."""
