"""The two mazes of a sliding block (C.1)."""
