"""`docs/results.md` and `docs/table11.md`: Tables 1 and 11 as pages, from the records."""

from __future__ import annotations

from studies.table1.paper import TRIALS_11
from studies.table1.tables import MISSING, Results, comparisons, planning, to_markdown

TITLES = {"default": "Preset `default`: velap's own settings", "paper": "Preset `paper`: Tables 2-10"}
HEADS = {
    "1": """# Results

`velap table 1` writes this page from the episode records in `results/records`. `results/table1.csv` holds every number,
`results/table1-PRESET.tex` the table for LaTeX. `{missing}`: not measured.

Records of velap 0.1, made with five recipes before [one search](adr/0089-one-search.md), count as another config's. Their
table is [kept](experiments/2026-11-five-recipes.md); nothing of it is below.

Success is the share of solved episodes over the test seeds 0 to {last} [%]. One training seed: the 95 % Wilson
interval in brackets. Several training seeds: mean ± sample standard deviation over them. `paper`: Table 1 of VELAP (CoRL
2023), mean ± standard deviation on the authors' data and simulation. All methods of a task, preset and training seed share
one joint checkpoint (App. D).""",
    "11": """# Table 11: the robot tasks, simulated

`velap table 11` writes this page from the episode records in `results/records`. `results/table11.csv` holds every number,
`results/table11-PRESET.tex` the table for LaTeX. `{missing}`: not measured.

The paper moves a real WidowX 200. Ours is simulated ([how](adr/0087-simulated-robot.md)), and a scripted operator makes its
data, so the two rows of a cell are not the same experiment: what compares is the order of the methods.

Success is the share of solved episodes over the test seeds 0 to {last} [%]. One training seed: the 95 % Wilson
interval in brackets. Several training seeds: mean ± sample standard deviation over them. `paper`: successful episodes of
{trials} on the robot, Table 11 of VELAP (CoRL 2023); so few leave 95 % Wilson intervals of up to 40 points. All methods of a
task, preset and training seed share one joint checkpoint (App. D).""",
}


def results_page(results: Results, episodes: int) -> str:
    """The whole page."""
    parts = [HEADS[results.number].format(missing=MISSING, last=episodes - 1, trials=TRIALS_11)]
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
    task = "SpiralMaze" if results.number == "1" else "Sponge"
    parts.append(f"""## How to reproduce

```
velap table {results.number} --jobs 2
```

makes what is missing and writes this page. After an interruption the same command goes on; an evaluation loses one episode
at most. `--dry-run` shows what is there and what is missing. `--only task={task} method=bc,iql` picks cells. Records of
another config are named above; `--fresh` moves them aside and makes them anew.""")
    return "\n\n".join(parts) + "\n"
