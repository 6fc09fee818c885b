"""Kills, spoilt files, wrong commands and full disks: what a user may meet, tried on purpose."""
