"""Table 1 of the paper: its cells, the workflow that makes them (`Snakefile`) and the tables made of their records."""
