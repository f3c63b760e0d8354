"""The paper's six trials and its results (section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

from harness import check_known
from studies.sampling_accuracy.data import DataOptions

NAN = float("nan")


@dataclass(frozen=True)
class Trial:
    """One trial.

    Attributes:
        name: name in the paper.
        options: options of its data.
        paper_predictor: the paper's correlation for the predictor alone.
        paper_combined: the same for predictor and conditioner combined.
        seeds: number of seeds in a full run; more if data sets are tiny and differ strongly.
    """

    name: str
    options: DataOptions
    paper_predictor: float
    paper_combined: float
    seeds: int = 20

    @property
    def about(self) -> str:
        """Short description of its data."""
        o = self.options
        return f"d = {o.d}, {'high' if o.correlated else 'low'} correlation, c = {o.c}, {o.n_inputs} inputs"


TRIALS: tuple[Trial, ...] = (
    Trial("1a", DataOptions(2, 4, correlated=False), 0.80, 0.93, seeds=60),
    Trial("1b", DataOptions(2, 4), 0.51, 0.89, seeds=60),
    Trial("2a", DataOptions(8, 3), 0.42, 0.89),
    Trial("2b", DataOptions(8, 5), 0.27, 0.79),
    Trial("2c", DataOptions(8, 10), 0.41, 0.67),
    Trial("3", DataOptions(32, 5), -0.12, 0.56, seeds=5),
)


SCALING: tuple[Trial, ...] = (
    *(Trial(f"d = {d}", DataOptions(d, 5), NAN, NAN, seeds=3) for d in (2, 4, 8, 16)),
    Trial("d = 32", DataOptions(32, 5), NAN, NAN, seeds=1),
    Trial("d = 64", DataOptions(64, 5, multiplier=0.25), NAN, NAN, seeds=1),
)
"""Growing numbers of variables; the last has as many inputs as the previous one, so that the fit takes only minutes."""


def find_trial(name: str) -> Trial:
    """The trial called ``name``, one of the paper's or of those with growing numbers of variables.

    Raises:
        ValueError: there is none; the message lists the known names.
    """
    known = {trial.name: trial for trial in (*TRIALS, *SCALING)}
    if name not in known:
        check_known("trial", [name], [trial.name for trial in TRIALS])
    return known[name]
