"""The agent: it explores, fits a transition model to what it observed, and plans."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, cast, runtime_checkable

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv

from mbagent.arguments import (
    check_callback,
    check_count,
    check_device,
    check_exploration,
    check_learning_rate,
    check_model,
    check_policy,
    check_seed,
    check_timesteps,
    fitting_model,
    planner_settings,
)
from mbagent.checkpoint import SavableAlgorithm
from mbagent.data import Experience, ExperienceRecorder, TransitionDataset, distinct_rows, warn_of_forgetting
from mbagent.environments import ENDED, has_ended, naming_ended_processes, step, wrap_env
from mbagent.explain import Explanation, explain
from mbagent.exploration.strategies import EXPLORATIONS, Exploration, Watching, catch_up
from mbagent.models.base import FitReport
from mbagent.models.neural.connections import PruningConfig, check_fraction
from mbagent.models.protocol import TransitionModel
from mbagent.models.registry import build_model
from mbagent.models.reward import LearnedReward
from mbagent.policies import FlatMonteCarloPolicy, MctsPolicy, PlannerPolicy, ValueIterationPolicy
from mbagent.rewards import GoalBook, RewardFn
from mbagent.spaces import ActionEnumeration, FactoredSpace

if TYPE_CHECKING:
    pass


def check_progress(show: bool) -> None:
    """Whether a progress bar can be shown, if one is asked for.

    Raises:
        ImportError: a package is missing; the message names the pip line.
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
    """A function to tell the share of a fit that is done, shown as a bar; None without ``show``, see ``check_progress``."""
    if not show:
        yield None
        return
    from tqdm.auto import tqdm  # noqa: PLC0415 - optional

    with tqdm(total=100, desc="fitting the model", unit="%") as bar:

        def tell(share: float) -> None:
            bar.update(round(100 * share) - bar.n)

        yield tell
        bar.update(100 - bar.n)


def log_fit(logger: Logger, report: FitReport, n_updates: int, n_transitions: int, n_start_states: int) -> None:
    """Writes the ``train/`` and ``model/`` figures of a fit to the log.

    Args:
        logger: SB3's logger.
        report: what the fit did.
        n_updates: fits so far.
        n_transitions: transitions met so far.
        n_start_states: distinct start states known.
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
        agent: whose buffers of episodes are read.
        began: when ``learn`` began, nanoseconds since the epoch.
        steps_before: environment steps before that.
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


@runtime_checkable
class PrunableModel(Protocol):
    """A transition model that has connections to remove; see ``NeuralTransitionModel.prune``."""

    def prune(
        self,
        data: TransitionDataset,
        fraction: float,
        *,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        config: PruningConfig | None = None,
    ) -> FitReport:
        """Removes connections and trains what is left; leaves the model as it was where that fails."""
        ...


class PrunableAlgorithm(SavableAlgorithm):
    """What ModelLearningAgent does to make its model smaller."""

    def prune(self, fraction: float, *, progress_bar: bool = False, config: PruningConfig | None = None) -> Self:
        """Removes the smallest weights of the model's networks, trains what is left on the transitions met, and plans on with it.

        Each network loses this share of its connections, and those left over that the transitions do not call for; the goal
        stays. Pruned again, the agent goes on from what is left. ``learn`` fits anew, with all connections.

        Args:
            fraction: least share of the connections that are gone afterwards, 0 or more and less than 1.
            progress_bar: shows one.
            config: how, see PruningConfig; ``PruningConfig(evidence=False)`` removes this share and no more.

        Raises:
            ValueError: a fraction out of range, nothing learned yet, or no transitions to train on (after ``load``).
            TypeError: the model has no weights. The agent is as it was in each of these cases, as after any other error.
        """
        agent = cast("ModelLearningAgent", self)
        fraction, model = check_fraction(fraction), prunable(agent.model)
        if not agent.policy.fitted:
            raise ValueError("There is nothing to prune yet: call learn() first.")
        if not len(agent.experience.dataset):
            raise ValueError(
                "prune() trains what is left on the transitions met, and this agent has none: give it some with "
                "load_transitions(path), or save agents with include=['transitions']."
            )
        with agent.policy.lock, fit_progress(progress_bar) as progress:
            report = model.prune(agent.transitions, fraction, seed=agent._planning_seed, progress=progress, config=config)
            agent._n_updates += 1
            agent.fit_report = report
            agent._refresh()
        if hasattr(agent, "_logger"):  # a loaded agent has none before it learns
            log_fit(agent.logger, report, agent._n_updates, len(agent.transitions), len(agent.policy.start_states))
        return self


def prunable(model: TransitionModel) -> PrunableModel:
    """The model, if it can be pruned.

    Raises:
        TypeError: it has no weights; the message says what to do.
    """
    if isinstance(model, PrunableModel):
        return model
    raise TypeError(
        f"This agent's model, {type(model).__name__}, has no connections to prune: decision graphs and tables hold only what the "
        "data called for. Learn with model='networks' or model='paper' to prune networks."
    )


ITERATION_STEPS = 1000
"""Environment steps between two looks at the logger."""

EXPLORING = 0xE8
"""Salt of the random numbers of exploration: an environment with the same seed must not draw the same ones."""

MAX_START_STATES = 512
"""Start states kept for generating the reachable machine."""


class ModelLearningAgent(PrunableAlgorithm):
    """An SB3 algorithm that learns how the world works without reward, and plans on what it learned.

    ``learn`` explores, records transitions and fits a transition model (paper section 3). ``predict`` plans
    on the model (section 4) towards the current goal: the environment's own reward, or whatever ``set_reward`` names.

    Any number of threads may call ``predict``, ``explain``, ``set_reward``, ``save`` and ``get_parameters`` of one agent while
    another one is in ``learn``, ``prune`` or ``set_parameters``: calls wait for each other, and their results are those of one
    thread. To plan in parallel, give each thread or process an agent of its own (``copy.deepcopy(agent)``).

    Args:
        policy: the planner: "MctsPolicy" (also "MlpPolicy", "CnnPolicy", "MultiInputPolicy"), "FlatMonteCarloPolicy",
            "ValueIterationPolicy", or a subclass of PlannerPolicy.
        env: a Gymnasium environment, an SB3 VecEnv, or a registered id; its spaces must be discrete (see
            FactoredSpace).
        learning_rate: largest rate of the fit's one-cycle schedule; a function of progress is evaluated at its start.
        reward: the goal, see RewardFn; None for the environment's own.
        model: "auto" (at present "graphs": decision graphs found from data), "networks" (predictor and conditioner trained
            by gradient), "paper" (section 3's networks), "tabular", "direct" (see ``forecasts``), another registered name,
            or a TransitionModel.
        exploration: "auto" ("directed" while the states that matter are few, else "random"), "persistent", or an Exploration.
        gamma: discount of a step when planning.
        num_simulations: simulations for each decision.
        time_budget: seconds for each decision instead (see PlannerSettings), or None.
        horizon: steps a simulation looks ahead, at most.
        policy_kwargs: further PlannerSettings, by name.
        stats_window_size: episodes that rollout figures in the log average over.
        tensorboard_log: folder for TensorBoard.
        verbose: 0 nothing, 1 the log, 2 more.
        seed: of exploration, fit and planning; None draws one.
        device: torch device ("auto" and "cpu" are the same: the networks are small).

    Raises:
        TypeError, ValueError: an unsupported space, an unknown name or a setting out of range, in one sentence.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MctsPolicy": MctsPolicy,
        "MlpPolicy": MctsPolicy,
        "CnnPolicy": MctsPolicy,
        "MultiInputPolicy": MctsPolicy,
        "FlatMonteCarloPolicy": FlatMonteCarloPolicy,
        "ValueIterationPolicy": ValueIterationPolicy,
    }
    policy: PlannerPolicy

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 0.02,
        *,
        reward: RewardFn | None = None,
        model: str | TransitionModel = "auto",
        exploration: str | Exploration = "auto",
        gamma: float = 0.99,
        num_simulations: int = 64,
        time_budget: float | None = None,
        horizon: int = 20,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        """See the class."""
        seed = check_seed(seed)
        super().__init__(
            check_policy(policy, self.policy_aliases),
            env,
            learning_rate,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=check_device(device),
            support_multi_env=True,
            seed=seed,
        )
        if not issubclass(self.policy_class, PlannerPolicy):
            raise TypeError(f"policy must be a planner policy such as 'MctsPolicy', got {self.policy_class.__name__}.")
        self.model_name, self.exploration_name = check_model(model), check_exploration(exploration)
        self.gamma, self.num_simulations, self.time_budget, self.horizon = gamma, num_simulations, time_budget, horizon
        self._custom_reward, self.fit_report = reward, cast("FitReport | None", None)
        self._planning_seed = seed if seed is not None else int(np.random.SeedSequence().generate_state(1)[0] >> 1)
        self._recorder: ExperienceRecorder | None = None
        self._rng = np.random.default_rng([self._planning_seed, EXPLORING])
        if _init_setup_model:
            self._setup_model()

    # ------------------------------------------------------------------ parts

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return wrap_env(env, verbose, monitor_wrapper)

    @property
    def model(self) -> TransitionModel:
        """The transition model."""
        return self.policy.transition_model

    @property
    def transitions(self) -> TransitionDataset:
        """What was met, in the model's factors."""
        return self.experience.coded(self.policy.factored)

    def _setup_model(self) -> None:
        if not hasattr(self, "observation_space"):
            raise ValueError("env must be an environment or a registered id, got None; load() is the way to an agent without.")
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        own = {name: getattr(self, name) for name in ("num_simulations", "time_budget", "gamma", "horizon")}
        settings = planner_settings(own, self.policy_kwargs, self._planning_seed)
        space, actions = FactoredSpace(self.observation_space), ActionEnumeration(self.action_space)
        self.experience = Experience(space, actions.n)
        if isinstance(self.model_name, str):  # a model that is given has the factors that it has
            space = self.experience.coding()
        model, reward_model = self._build_models(space, actions)
        policy = self.policy_class(
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            model=model,
            reward_model=reward_model,
            settings=settings,
            factored=space,
        )
        assert isinstance(policy, PlannerPolicy)
        self.policy = policy
        chosen = self.exploration_name
        self._explorer = EXPLORATIONS[chosen](actions.n) if isinstance(chosen, str) else chosen
        self.goals = GoalBook(policy, self.experience)
        if self.env is not None:
            self.goals.take_environment(self.env)
        start_states = getattr(model, "start_states", None)
        if start_states is not None:  # a model that needs no learning, such as the true simulator
            policy.start_states = distinct_rows(start_states(MAX_START_STATES))
            policy.fitted = True
        self.policy.refresh()
        self.set_reward(self._custom_reward) if self._custom_reward is not None else self._refresh()

    def _build_models(self, space: FactoredSpace, acts: ActionEnumeration) -> tuple[TransitionModel, LearnedReward]:
        """A transition model and a learned reward, both new, of these factors."""
        model, n, parts, rate = self.model_name, acts.n, acts.factored.cardinalities, check_learning_rate(self.lr_schedule(1.0))
        model = build_model(model, space, n, rate, parts) if isinstance(model, str) else fitting_model(model, space, n)
        return model, LearnedReward(space.cardinalities, n, space.planes, seed=self._planning_seed, parts=parts)

    def _recode(self, space: FactoredSpace) -> None:
        """Factors whose values are those of ``space``; where that changes anything, nothing is learned in them yet."""
        policy = self.policy
        if space.same_factors(policy.factored):
            return
        starts = space.narrow(np.asarray(policy.factored.widen(policy.start_states), dtype=np.int64))
        policy.recode(space, *self._build_models(space, policy.actions), starts, False)
        self.goals.recode()

    # ------------------------------------------------------------------ goals

    def set_reward(self, reward: RewardFn | None) -> None:
        """Changes the goal; nothing is learned anew and no weight of the transition model changes.

        A ``predict`` in another thread plans for the old goal or for the new one, never for a mixture.

        Args:
            reward: see RewardFn; None for the environment's own reward (or the learned one, see ``goals``).

        Raises:
            TypeError, ValueError: the function does not return one finite number a transition; the old goal stays.
            RuntimeError: it raised an error, the cause of this one; the old goal stays. (``predict`` raises this, too, where it
                fails for transitions that are only imagined; the next goal is planned for as if nothing had been.)
        """
        with self.policy.lock:
            self.policy.set_goal(self.goals.choose(reward))

    def explain(self, obs: Any, *, n_futures: int = 3, n_steps: int = 10) -> Explanation:
        """Why ``predict`` takes the action it takes: every action's value, standard error, visits and likeliest futures.

        The same call gives the same answer, and ``predict`` is not changed by it. It takes about ten times as long as a first
        decision. See Explanation for an example.

        Args:
            obs: one observation.
            n_futures: futures for each action, at most.
            n_steps: steps of each future, at most.

        Raises:
            ValueError: nothing is learned yet, no goal is known, or a batch is given.
        """
        return explain(self.policy, obs, n_futures, n_steps)

    def _refresh(self) -> None:
        """Drops every planning cache and works the goal out anew."""
        self.policy.goal = None
        self.policy.refresh()
        if self.policy.fitted:
            self.policy.set_goal(self.goals.current())

    # ------------------------------------------------------------------ learn

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 10,
        tb_log_name: str = "ModelLearningAgent",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Explores for ``total_timesteps`` steps, then fits the model to everything met so far.

        A run stopped by a callback still fits what it has. Called again, it goes on: transitions are kept. The fit comes
        at the end, so callbacks that evaluate or save on the way see the agent as it was before: for a learning curve,
        call it several times with ``reset_num_timesteps=False``.

        Args:
            total_timesteps: environment steps, over all copies of the environment; 0 only fits what was met before.
            callback: SB3 callbacks, called at every step.
            log_interval: iterations (of 1,000 steps) between two entries in the log; None for none.
            tb_log_name: name of the run in TensorBoard.
            reset_num_timesteps: False counts on from the last call.
            progress_bar: shows one (needs ``pip install "mbagent[progress]"``).

        Raises:
            TypeError, ValueError, ImportError: an argument is none of these; there is no environment, or nothing to fit; a
                package for the progress bar is missing. No step is taken then.
            TypeError, ValueError: the environment returned something else than it declares.
            RuntimeError: a process of a SubprocVecEnv has ended. After this or any other error the steps recorded so far are
                kept: ``learn(0)`` fits to them without using the environment; ``learn`` with more steps begins with a reset.
        """
        if self.env is None:
            raise ValueError("learn() needs an environment; give one with set_env(env) or load(path, env=env).")
        fresh_start = reset_num_timesteps or self._last_obs is None or self._recorder is None
        steps, log_interval = check_timesteps(total_timesteps), check_count("log_interval", log_interval, "no log")
        check_callback(callback)
        check_progress(progress_bar)
        if not steps and not len(self.experience.dataset):
            raise ValueError("learn(0) only fits the transitions collected so far, and there are none; ask for steps.")
        total, callbacks = self._setup_learn(steps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if self._recorder is None or (fresh_start and self._last_obs is not None):
            self._recorder = ExperienceRecorder(self.experience.space, self.experience.dataset, self.n_envs)
            if self._last_obs is not None:
                self._recorder.reset(self._last_obs)
            catch_up(self._explorer, self.experience.dataset)
        warn_of_forgetting(self.policy.fitted and isinstance(self.model_name, str), self.experience.dataset)
        callbacks.on_training_start(locals(), globals())
        going, iteration = True, 0
        try:
            while going and self.num_timesteps < total:
                going = self._explore(min(total, self.num_timesteps + ITERATION_STEPS), callbacks, self._recorder)
                iteration += 1
                self._update_current_progress_remaining(self.num_timesteps, max(total, 1))
                if log_interval is not None and iteration % log_interval == 0:
                    log_rollout(self, self.start_time, self._num_timesteps_at_start)
                    self.logger.dump(self.num_timesteps)
        finally:  # an interrupted run keeps what it met: learn(0) fits to it
            self._recorder.flush()
        if len(self.experience.dataset):
            self._recorder.warn_of_reused_arrays()
            with self.policy.lock, self._undone_on_error():
                self._fit(self._recorder, progress_bar)
            if log_interval is not None:
                log_rollout(self, self.start_time, self._num_timesteps_at_start)
                self.logger.dump(self.num_timesteps)
        callbacks.on_training_end()
        return self

    def _explore(self, until: int, callback: BaseCallback, recorder: ExperienceRecorder) -> bool:
        """Steps all environments until ``num_timesteps`` reaches ``until``; False if a callback stopped it."""
        env, watcher = cast("VecEnv", self.env), self._explorer if isinstance(self._explorer, Watching) else None
        callback.on_rollout_start()
        while self.num_timesteps < until:
            assert recorder.states is not None
            indices = self._explorer.act(recorder.states, self._rng)
            actions = self.policy.actions.decode(indices)
            self._last_obs = None  # should the step fail, it is not known where the environment stands
            new_obs, rewards, dones, infos = step(env, actions)
            self.num_timesteps += env.num_envs
            if (original := self._vec_normalize_env) is not None:
                new_obs, rewards = original.get_original_obs(), original.get_original_reward()
            recorded = recorder.record(indices, new_obs, rewards, dones, infos)
            self._last_obs, self._last_episode_starts = new_obs, dones
            if watcher is not None:
                watcher.observe(recorded.states, recorded.actions, recorded.next_states, dones)
            self._update_info_buffer(infos, dones)
            self._episode_num += int(dones.sum())
            callback.update_locals(locals())
            if not callback.on_step():
                return False
        callback.on_rollout_end()
        return True

    @contextmanager
    def _undone_on_error(self) -> Iterator[None]:
        """Puts back what the agent has learned if a fit does not come to its end: half of it must not be planned with."""
        policy, before, goal = self.policy, self.policy.parts(), self.policy.goal
        weights = policy.state_dict() if policy.fitted else {}
        try:
            yield
        except BaseException:
            if weights:
                policy.recode(*before)
                self.goals.recode()
                policy.load_state_dict(weights)
                policy.set_goal(goal)
            raise

    def _fit(self, recorder: ExperienceRecorder, progress_bar: bool) -> None:
        """Fits the model, then works out goal and machine."""
        if isinstance(self.model_name, str):
            self._recode(self.experience.coding())
        with fit_progress(progress_bar) as progress:
            report = self.model.fit(self.transitions, seed=self._planning_seed, progress=progress)
        self._n_updates, self.fit_report = self._n_updates + 1, report
        if report.advice is not None:
            warnings.warn(report.advice, UserWarning, stacklevel=3)
        starts = np.concatenate([self.policy.start_states, self.policy.factored.narrow(recorder.starts())])
        self.policy.start_states = distinct_rows(starts)[:MAX_START_STATES]
        self.policy.fitted = True
        self.goals.forget_learned()
        began = time.perf_counter()
        self._refresh()
        log_fit(self.logger, report, self._n_updates, len(self.transitions), len(self.policy.start_states))
        if len(self.policy.start_states) and self.policy.goal is not None:
            plan = self.policy.plan(self.policy.start_states[:1])
            self.logger.record("plan/start_value", float(plan.values.max()))
            self.logger.record("plan/first_seconds", time.perf_counter() - began)
            self.logger.record("plan/goal", self.goals.source)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Changes the environment (same spaces); without a custom reward the goal becomes the new environment's."""
        super().set_env(env, force_reset)
        assert self.env is not None
        self._recorder = None
        with self.policy.lock:
            self.goals.take_environment(self.env)
            self._refresh()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        """As SB3's; but for no steps at all an environment that has failed is left alone."""
        assert self.env is not None
        rest = tb_log_name, progress_bar
        ended = has_ended(self.env)
        if total_timesteps > 0 and ended:
            raise RuntimeError(ENDED)
        if total_timesteps > 0 or not (ended or (self._recorder is not None and self._last_obs is None)):
            with naming_ended_processes(self.env):
                return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *rest)
        if reset_num_timesteps:
            self.num_timesteps = self._episode_num = 0
        self._last_obs = np.zeros(0)  # one must be there for SB3 not to reset the environment
        try:
            return super()._setup_learn(0, callback, False, *rest)
        finally:
            self._last_obs = None
