"""The four manipulation tasks on Meta-World's physics (C.2)."""
