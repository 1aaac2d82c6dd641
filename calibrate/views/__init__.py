"""What was measured: views of a board with their corners, and how a lens projects points."""
