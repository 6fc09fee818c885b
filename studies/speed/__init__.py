"""Speed ratios, measured side by side."""
