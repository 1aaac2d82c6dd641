"""Arms: the table of known kinematics, and chains that are learned from recorded joints and poses."""
