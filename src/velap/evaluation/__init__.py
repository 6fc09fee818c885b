"""Playing seeded episodes, their records, and statistics over them."""
