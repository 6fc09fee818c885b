"""`docs/results.md`: Table 1 as a page, from the records."""

from __future__ import annotations

from studies.table1.tables import MISSING, Results, comparisons, planning, to_markdown

TITLES = {"default": "Preset `default`: velap's own settings", "paper": "Preset `paper`: Tables 2-10"}


def results_page(results: Results, episodes: int) -> str:
    """The whole page."""
    parts = [f"""# Results

`velap table 1` writes this page from the episode records in `results/records`. `results/table1.csv` holds every number,
`results/table1-PRESET.tex` the table for LaTeX. `{MISSING}`: not measured.

Records of velap 0.1, made with five recipes before [one search](adr/0089-one-search.md), count as another config's. Their
table is [kept](experiments/2026-11-five-recipes.md); nothing of it is below.

Success is the share of solved episodes over the test seeds 0 to {episodes - 1} [%]. One training seed: the 95 % Wilson
interval in brackets. Several training seeds: mean ± sample standard deviation over them. `paper`: Table 1 of VELAP (CoRL
2023), mean ± standard deviation on the authors' data and simulation. All methods of a task, preset and training seed share
one joint checkpoint (App. D)."""]
    for preset in results.presets:
        runs = results.of(preset)
        parts.append(f"## {TITLES.get(preset, preset)}\n\n{to_markdown(runs)}")
        costs = planning(runs)
        if len(costs):
            parts.append("VELAP, mean over its training seeds. A step is led by a plan where its action follows an edge of "
                         f"the current tree.\n\n{costs.to_markdown(disable_numparse=True)}")
    against = comparisons(results)
    if len(against):
        parts.append("## VELAP against the best baseline\n\nMcNemar's exact test, two-sided, on episodes of equal "
                     "training and episode seed; it rests on the discordant pairs, in which exactly one of the two methods "
                     "succeeds. The baseline is the one with the highest rate, chosen after the fact.\n\n"
                     + against.to_markdown(index=False, disable_numparse=True))
    parts.append("## Left out and mixed\n\n" + ("\n".join(f"- {note}" for note in results.notes) or "Nothing."))
    parts.append("""## How to reproduce

```
velap table 1 --jobs 2
```

makes what is missing and writes this page. After an interruption the same command goes on; an evaluation loses one episode
at most. `--dry-run` shows what is there and what is missing. `--only task=SpiralMaze method=bc,iql` picks cells. Records of
another config are named above; `--fresh` moves them aside and makes them anew.""")
    return "\n\n".join(parts) + "\n"
