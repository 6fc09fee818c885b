"""Encoders φ: frames to latents."""
