"""`velap table > log`: 80 columns, names cut to `Button...` and `bc-suc...` (vladmandic/sdnext#1520)."""

from case import CHECKOUT, run, verdict

code, text = run("table", "--records", CHECKOUT / "results/records-five-recipes")
verdict("bc-success" in text and "ButtonWall" in text, "whole names where the output is no terminal")
