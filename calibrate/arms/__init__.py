"""Arms: known kinematics, chains learned from joints and poses, and classes of arms with their errors."""
