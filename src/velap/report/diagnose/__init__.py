"""Where a trained model fails, and what to try."""
