"""Progress bars and log entries of ``learn`` and ``prune``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import safe_mean

from mbagent.models.fit_report import FitReport


def check_progress(show: bool) -> None:
    """If ``show``, checks that the packages for a progress bar are installed.

    Raises:
        ImportError: a package is missing; the message contains the pip command.
    """
    if not show:
        return
    try:
        import rich  # noqa: F401, PLC0415 - optional
        import tqdm  # noqa: F401, PLC0415 - optional
    except ImportError as error:
        raise ImportError(
            f'progress_bar=True needs the package {error.name}: pip install "mbagent[progress]", or learn without the bar.'
        ) from error


@contextmanager
def fit_progress(show: bool) -> Iterator[Callable[[float], None] | None]:
    """Yields a function that shows a fit's completed share in a bar, or None if ``show`` is false; see ``check_progress``."""
    if not show:
        yield None
        return
    from tqdm.auto import tqdm  # noqa: PLC0415 - optional

    with tqdm(total=100, desc="fitting the model", unit="%") as bar:

        def update(share: float) -> None:
            bar.update(round(100 * share) - bar.n)

        yield update
        bar.update(100 - bar.n)


def log_fit(logger: Logger, report: FitReport, n_updates: int, n_transitions: int, n_start_states: int) -> None:
    """Writes the ``train/`` and ``model/`` figures of a fit to the log.

    Args:
        logger: SB3's logger.
        report: report of the fit.
        n_updates: fits so far.
        n_transitions: transitions observed so far.
        n_start_states: number of distinct start states.
    """
    figures = {
        "predictor_loss": report.predictor_loss,
        "conditioner_loss": report.conditioner_loss,
        "exact_match": report.exact_match,
        "calibration": report.calibration,
        "memory": report.memory,
        "epochs": report.epochs,
        "fit_seconds": report.seconds,
    }
    for name, value in figures.items():
        if value is not None:
            logger.record(f"train/{name}", value)
    logger.record("train/n_updates", n_updates, exclude="tensorboard")
    logger.record("model/transitions", n_transitions)
    logger.record("model/start_states", n_start_states)
    for name, value in report.log.items():
        logger.record(f"model/{name}", value)


def log_rollout(agent: BaseAlgorithm, began: float, steps_before: int) -> None:
    """Writes the ``rollout/`` and ``time/`` figures to the agent's log.

    Args:
        agent: the agent, including its episode buffers.
        began: start time of ``learn``, nanoseconds since the epoch.
        steps_before: number of environment steps before ``learn`` started.
    """
    seconds, logger = max((time.time_ns() - began) / 1e9, 1e-9), agent.logger
    if agent.ep_info_buffer:
        logger.record("rollout/ep_rew_mean", safe_mean([info["r"] for info in agent.ep_info_buffer]))
        logger.record("rollout/ep_len_mean", safe_mean([info["l"] for info in agent.ep_info_buffer]))
    if agent.ep_success_buffer:
        logger.record("rollout/success_rate", safe_mean(agent.ep_success_buffer))
    logger.record("time/fps", int((agent.num_timesteps - steps_before) / seconds))
    logger.record("time/time_elapsed", int(seconds), exclude="tensorboard")
    logger.record("time/total_timesteps", agent.num_timesteps, exclude="tensorboard")
