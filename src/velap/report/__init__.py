"""Pictures, videos and diagnoses of trained models."""
