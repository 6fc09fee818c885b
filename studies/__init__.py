"""Studies that run from a checkout: the tables of the paper, faults, speed, pictures of the documentation."""
