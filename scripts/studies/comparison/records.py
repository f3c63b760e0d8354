"""Results of one training and its evaluation, as plain data that survives a crash."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbagent import files

AGENT = "Model-learning agent"
LEARNED_REWARD = "Model-learning agent, reward learned too"
TRUE_MODEL = "Same planner on the true model"
RANDOM = "Random play"
REFERENCE = "Reference"

CSV_COLUMNS = (
    "case",
    "agent",
    "goal",
    "seed",
    "environment_steps",
    "episodes",
    "mean_return",
    "std_return",
    "random_return",
    "reference_return",
    "normalised_return",
    "learn_seconds",
    "ms_per_decision",
    "curve_point",
    "weights_before",
    "weights_after",
)
"""Columns of results.csv."""


@dataclass(frozen=True)
class Record:
    """One agent trained once on one case and scored for one goal.

    Attributes:
        case: key of the case.
        agent: name of the agent.
        goal: name of the reward function used for scoring.
        seed: training seed.
        steps: environment steps used for learning.
        returns: undiscounted return of each episode.
        learn_seconds: wall time of learning (exploring and fitting, or training), without evaluations.
        decision_ms: median milliseconds per decision for one observation; NaN if not measured.
        curve: (environment steps, mean return) during learning; may be empty.
        weights_before: hash of the transition model's weights before the goal was given; empty without a
            model.
        weights_after: the same after planning for the goal.
        curve_point: whether the training was shorter and only gives a point of a learning curve.
        extra: further results.
    """

    case: str
    agent: str
    goal: str
    seed: int
    steps: int
    returns: tuple[float, ...]
    learn_seconds: float = 0.0
    decision_ms: float = float("nan")
    curve: tuple[tuple[int, float], ...] = ()
    weights_before: str = ""
    weights_after: str = ""
    curve_point: bool = False
    extra: Mapping[str, float] = field(default_factory=dict)

    @property
    def mean(self) -> float:
        """Mean return over the episodes."""
        return float(np.mean(self.returns))


def write_records(path: Path, records: Sequence[Record]) -> None:
    """Writes records as JSON, atomically."""
    files.write(path, json.dumps([asdict(record) for record in records]))


def read_records(path: Path) -> list[Record]:
    """Reads a file of ``write_records``."""
    rows = json.loads(path.read_text(encoding="utf-8"))
    return [Record(**{**row, "returns": tuple(row["returns"]), "curve": tuple((s, r) for s, r in row["curve"])}) for row in rows]


def write_csv(path: Path, records: Sequence[Record], normalise: Mapping[tuple[str, str], tuple[float, float]]) -> None:
    """Writes one line per record.

    Args:
        path: the file.
        records: the records.
        normalise: (random, reference) mean returns by (case, goal).
    """
    file = io.StringIO()
    writer = csv.writer(file)
    writer.writerow(CSV_COLUMNS)
    for r in records:
        random, reference = normalise.get((r.case, r.goal), (float("nan"), float("nan")))
        score = (r.mean - random) / (reference - random) if reference > random else float("nan")
        numbers = (
            r.mean,
            float(np.std(r.returns)),
            random,
            reference,
            score,
            r.learn_seconds,
            r.decision_ms,
        )
        names = (r.case, r.agent, r.goal, r.seed, r.steps, len(r.returns))
        writer.writerow(
            [
                *names,
                *(f"{n:.6g}" for n in numbers),
                int(r.curve_point),
                r.weights_before,
                r.weights_after,
            ]
        )
    files.write(path, file.getvalue())


def hash_weights(state: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 over names, types, shapes and bytes of all arrays of a ``state_dict``."""
    digest = hashlib.sha256()
    for name in sorted(state):
        array = np.ascontiguousarray(state[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
