"""Sampling-based planning over callables: nothing here knows a network or a simulator."""
