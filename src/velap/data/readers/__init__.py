"""Readers of dataset formats, one file each; `velap.data.loading` says what a reader is."""
