"""The agent: explores, fits a transition model to the observed transitions, and plans."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, Self, cast

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import check_for_correct_spaces, get_system_info
from stable_baselines3.common.vec_env import VecEnv

from mbagent import checkpoint
from mbagent.arguments import (
    check_callback,
    check_count,
    check_device,
    check_exploration,
    check_learning_rate,
    check_model,
    check_overrides,
    check_policy,
    check_seed,
    check_timesteps,
    fitting_model,
    planner_settings,
    policy_name,
)
from mbagent.checkpoint import SETTINGS, AgentState
from mbagent.data import Experience, ExperienceRecorder, TransitionDataset, distinct_rows, warn_of_forgetting
from mbagent.environments import EnvironmentAlgorithm, step
from mbagent.explain import Explanation, explain
from mbagent.exploration.strategies import EXPLORATIONS, Exploration, Watching, catch_up
from mbagent.files import Target
from mbagent.models.fit_report import FitReport
from mbagent.models.neural.connections import PruningConfig, check_fraction, prunable
from mbagent.models.protocol import TransitionModel
from mbagent.models.registry import build_model
from mbagent.models.reward import LearnedReward
from mbagent.policies import FlatMonteCarloPolicy, MctsPolicy, PlannerPolicy, ValueIterationPolicy
from mbagent.rewards import RewardFn, RewardSelector
from mbagent.spaces import ActionEnumeration, FactoredSpace, space_from_json, space_to_json
from mbagent.training_log import check_progress, fit_progress, log_fit, log_rollout

ITERATION_STEPS = 1000
"""Environment steps of one iteration; ``log_interval`` counts iterations."""

EXPLORING = 0xE8
"""Salt of the random numbers of exploration, so that they differ from those of an environment with the same seed."""

MAX_START_STATES = 512
"""Largest number of start states from which the reachable MDP is generated."""


class ModelLearningAgent(EnvironmentAlgorithm):
    """An SB3 algorithm that learns a transition model without using rewards, and plans with this model.

    ``learn`` explores, records transitions and fits a transition model (paper section 3). ``predict`` plans
    with the model (section 4) for the current goal: the environment's own reward, or the function given to ``set_reward``.

    Several threads may call ``predict``, ``explain``, ``set_reward``, ``save`` and ``get_parameters`` of one agent while another
    thread is in ``learn``, ``prune`` or ``set_parameters``: conflicting calls wait for each other, so the results are as if they
    had run one after the other. To plan in parallel, give each thread or process a copy (``copy.deepcopy(agent)``).

    Args:
        policy: the planner: "MctsPolicy" (also "MlpPolicy", "CnnPolicy", "MultiInputPolicy"), "FlatMonteCarloPolicy",
            "ValueIterationPolicy", or a subclass of PlannerPolicy.
        env: a Gymnasium environment, an SB3 VecEnv, or a registered id; its spaces must be discrete (see
            FactoredSpace).
        learning_rate: peak of the fit's one-cycle schedule; of an SB3 schedule (a function), only the initial value is used.
        reward: the reward function to plan for, see RewardFn; None for the environment's own.
        model: "auto" (at present "graphs": decision graphs fitted to data), "networks" (predictor and conditioner trained
            by gradient descent), "paper" (section 3's networks), "tabular", "direct" (see ``models.neural.forecasts``), another
            registered name, or a TransitionModel.
        exploration: "directed", "random", "auto" (directed if there are few states), "persistent", or an Exploration.
        gamma: discount factor per step in planning.
        num_simulations: simulations for each decision.
        time_budget: seconds for each decision, replacing ``num_simulations`` (see PlannerSettings); None for no time budget.
        horizon: largest number of steps of a simulation.
        policy_kwargs: further PlannerSettings, by name.
        stats_window_size: number of episodes over which rollout statistics in the log are averaged.
        tensorboard_log: folder for TensorBoard.
        verbose: 0 for no output, 1 for the log, 2 for more.
        seed: seed for exploration, fitting and planning; None for a random seed.
        device: torch device; "auto" means "cpu", since the networks are small.

    Raises:
        TypeError, ValueError: an unsupported space, an unknown name or a setting out of range; the message is one sentence.
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
    _recorder: ExperienceRecorder | None = None

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
        self.model_name, self.exploration_name = check_model(model), check_exploration(exploration)
        self.gamma, self.num_simulations, self.time_budget, self.horizon = gamma, num_simulations, time_budget, horizon
        self._custom_reward, self.fit_report = reward, cast("FitReport | None", None)
        self._planning_seed = seed if seed is not None else int(np.random.SeedSequence().generate_state(1)[0] >> 1)
        self._rng = np.random.default_rng([self._planning_seed, EXPLORING])
        if _init_setup_model:
            self._setup_model()

    @property
    def model(self) -> TransitionModel:
        """The transition model."""
        return self.policy.transition_model

    @property
    def transitions(self) -> TransitionDataset:
        """The observed transitions, encoded in the model's factors."""
        return self.experience.coded(self.policy.factored)

    def _setup_model(self) -> None:
        if not hasattr(self, "observation_space"):
            raise ValueError("env must be an environment or a registered id, got None; use load() for an agent without one.")
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        own = {name: getattr(self, name) for name in ("num_simulations", "time_budget", "gamma", "horizon")}
        settings = planner_settings(own, self.policy_kwargs, self._planning_seed)
        space, actions = FactoredSpace(self.observation_space), ActionEnumeration(self.action_space)
        self.experience = Experience(space, actions.n)
        if isinstance(self.model_name, str):  # the factors of a given model are fixed
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
        self.goals = RewardSelector(policy, self.experience)
        if self.env is not None:
            self.goals.take_environment(self.env)
        start_states = getattr(model, "start_states", None)
        if start_states is not None:  # a model that needs no learning, such as the true simulator
            policy.start_states = distinct_rows(start_states(MAX_START_STATES))
            policy.fitted = True
        self.policy.refresh()
        self.set_reward(self._custom_reward) if self._custom_reward is not None else self._refresh()

    def _build_models(self, space: FactoredSpace, acts: ActionEnumeration) -> tuple[TransitionModel, LearnedReward]:
        """A new transition model and a new learned reward for these factors."""
        model, n, parts, rate = self.model_name, acts.n, acts.factored.cardinalities, check_learning_rate(self.lr_schedule(1.0))
        model = build_model(model, space, n, rate, parts) if isinstance(model, str) else fitting_model(model, space, n)
        return model, LearnedReward(space.cardinalities, n, space.planes, seed=self._planning_seed, parts=parts)

    def _recode(self, space: FactoredSpace) -> None:
        """Adopts the factor values of ``space``; if they changed, replaces model and learned reward by unfitted ones."""
        policy = self.policy
        if space.same_factors(policy.factored):
            return
        starts = space.narrow(np.asarray(policy.factored.widen(policy.start_states), dtype=np.int64))
        policy.recode(space, *self._build_models(space, policy.actions), starts, False)
        self.goals.recode()

    def set_reward(self, reward: RewardFn | None) -> None:
        """Changes the goal; the transition model is neither fitted again nor changed.

        A ``predict`` in another thread plans for either the old goal or the new one, never for a mixture.

        Args:
            reward: see RewardFn; None for the environment's own reward (or the learned one, see RewardSelector).

        Raises:
            TypeError, ValueError: the function does not return one finite number per transition; the old goal is kept.
            RuntimeError: the function raised an error, available as ``__cause__``; the old goal is kept. ``predict`` also raises
                RuntimeError if the function fails for simulated transitions; this does not affect planning for goals set later.
        """
        with self.policy.lock:
            self.policy.set_goal(self.goals.choose(reward))

    def explain(self, obs: Any, *, n_futures: int = 3, n_steps: int = 10) -> Explanation:
        """Explains the action that ``predict`` takes: each action's value, standard error, visits and most probable futures.

        The result is reproducible, and later calls of ``predict`` are not affected. A call takes about ten times as long as the
        first ``predict`` for a goal. See Explanation for an example.

        Args:
            obs: one observation.
            n_futures: largest number of futures for each action.
            n_steps: largest number of steps of each future.

        Raises:
            ValueError: nothing is learned yet, no goal is known, or ``obs`` is a batch.
        """
        return explain(self.policy, obs, n_futures, n_steps)

    def _refresh(self) -> None:
        """Clears all planning caches and selects the goal again."""
        self.policy.goal = None
        self.policy.refresh()
        if self.policy.fitted:
            self.policy.set_goal(self.goals.current())

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 10,
        tb_log_name: str = "ModelLearningAgent",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Explores for ``total_timesteps`` steps, then fits the model to all transitions observed so far.

        If a callback stops the run, the model is fitted to the steps taken until then. Later calls keep all earlier transitions.
        Callbacks that evaluate or save the agent during the run see it as it was before the run, since the model is fitted only
        at the end. For a learning curve, call ``learn`` several times with ``reset_num_timesteps=False``.

        Args:
            total_timesteps: steps, summed over all parallel environments; 0 only fits the model to earlier transitions.
            callback: SB3 callbacks, called at every step.
            log_interval: iterations (of 1,000 steps) between two entries in the log; None for no log.
            tb_log_name: name of the run in TensorBoard.
            reset_num_timesteps: False continues the count of the last call.
            progress_bar: whether to show a progress bar (needs ``pip install "mbagent[progress]"``).

        Raises:
            TypeError, ValueError, ImportError: an argument is invalid, there is no environment, there are no transitions to fit
                to, or a package for the progress bar is missing. No step is taken in these cases.
            TypeError, ValueError: the environment returned values that do not match its declared spaces.
            RuntimeError: a process of a SubprocVecEnv has ended. After this or any other error the steps recorded so far are
                kept: ``learn(0)`` fits to them without a step; after a failed step, ``learn`` begins with a reset.
        """
        if self.env is None:
            raise ValueError("learn() needs an environment; give one with set_env(env) or load(path, env=env).")
        fresh_start = reset_num_timesteps or self._last_obs is None or self._recorder is None
        steps, log_interval = check_timesteps(total_timesteps), check_count("log_interval", log_interval, "no log")
        check_callback(callback)
        check_progress(progress_bar)
        if not steps and not len(self.experience.dataset):
            raise ValueError("learn(0) only fits the transitions collected so far, and there are none; give a number of steps.")
        total, callbacks = self._setup_learn(steps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if self._recorder is None or (fresh_start and self._last_obs is not None):
            self._recorder = ExperienceRecorder(self.experience.space, self.experience.dataset, self.n_envs)
            if self._last_obs is not None:
                self._recorder.reset(self._last_obs)
            catch_up(self._explorer, self.experience.dataset)
        warn_of_forgetting(self.policy.fitted and isinstance(self.model_name, str), self.experience.dataset)
        callbacks.on_training_start(locals(), globals())
        running, iteration = True, 0
        try:
            while running and self.num_timesteps < total:
                running = self._explore(min(total, self.num_timesteps + ITERATION_STEPS), callbacks, self._recorder)
                iteration += 1
                self._update_current_progress_remaining(self.num_timesteps, max(total, 1))
                if log_interval is not None and iteration % log_interval == 0:
                    log_rollout(self, self.start_time, self._num_timesteps_at_start)
                    self.logger.dump(self.num_timesteps)
        finally:  # an interrupted run keeps its transitions, and learn(0) fits to them
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
        """Steps all environments until ``num_timesteps`` reaches ``until``; returns False if a callback stopped the run."""
        env, watcher = cast("VecEnv", self.env), self._explorer if isinstance(self._explorer, Watching) else None
        callback.on_rollout_start()
        while self.num_timesteps < until:
            assert recorder.states is not None
            indices = self._explorer.act(recorder.states, self._rng)
            actions = self.policy.actions.decode(indices)
            self._last_obs = None  # if the step fails, the environment's state is unknown
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
        """Restores the previous models if a fit fails or is interrupted, so that incomplete ones are never used for planning."""
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
        """Fits the model, selects the goal, makes a first plan and logs the results."""
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

    def prune(self, fraction: float, *, progress_bar: bool = False, config: PruningConfig | None = None) -> Self:
        """Removes the smallest weights of the model's networks and trains the remaining ones on the observed transitions.

        Each network loses the share ``fraction`` of its connections, and others that the transitions do not support; the goal is
        kept. Connections removed by earlier calls count towards ``fraction``; ``learn`` starts again with all connections.

        Args:
            fraction: minimum share of each network's connections to remove, in [0, 1).
            progress_bar: whether to show a progress bar.
            config: see PruningConfig; with ``PruningConfig(evidence=False)``, exactly the share ``fraction`` is removed.

        Raises:
            ValueError: ``fraction`` is out of range, nothing is learned yet, or (as after ``load``) there are no transitions.
            TypeError: the model has no weights. After these or any other errors the agent is unchanged.
        """
        fraction = check_fraction(fraction)
        model = prunable(self.model, self.policy.fitted, len(self.experience.dataset))
        with self.policy.lock, fit_progress(progress_bar) as progress:
            report = model.prune(self.transitions, fraction, seed=self._planning_seed, progress=progress, config=config)
            self._n_updates += 1
            self.fit_report = report
            self._refresh()
        if hasattr(self, "_logger"):  # a loaded agent has no logger before ``learn``
            log_fit(self.logger, report, self._n_updates, len(self.transitions), len(self.policy.start_states))
        return self

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Adopts an environment with the same spaces and, without a custom reward, that environment's reward as the goal."""
        super().set_env(env, force_reset)
        assert self.env is not None
        self._recorder = None
        with self.policy.lock:
            self.goals.take_environment(self.env)
            self._refresh()

    def state(self, transitions: bool = False) -> AgentState:
        """Settings, weights, start states and the learned reward as plain data, see ``from_state``.

        Args:
            transitions: whether to include the transitions.

        Raises:
            ValueError: the model, the exploration or the policy is an object, which cannot be rebuilt from plain data.
        """
        if not isinstance(self.model_name, str):
            raise ValueError(
                f"This agent's model is a {type(self.model).__name__} object, which a file without code cannot rebuild; "
                "register a factory with mbagent.models.register_model(name, factory) and pass model=name."
            )
        if not isinstance(self.exploration_name, str):
            raise ValueError("This agent's exploration is an object, which a file cannot rebuild; pass it by name.")
        policy = self.policy
        with policy.lock:
            if policy.fitted:
                self.goals.fit_learned()  # the goal of a loaded agent without an environment
            arrays = {"policy": policy.arrays(), "planning": {"start_states": policy.start_states}}
            if transitions:
                rows = self.experience.dataset.rows()
                arrays["transitions"] = {name: getattr(rows, name) for name in rows.__dataclass_fields__}
            settings = {name: getattr(self, name) for name in SETTINGS if name != "stats_window_size"}
            data = {
                "policy_class": policy_name(self.policy_class, self.policy_aliases),
                "observation_space": space_to_json(self.observation_space),
                "action_space": space_to_json(self.action_space),
                "settings": {**settings, "stats_window_size": self._stats_window_size},
                "learning_rate": float(self.lr_schedule(1.0)),
                "model": self.model_name,
                "exploration": self.exploration_name,
                "planning_seed": self._planning_seed,
                "reward_source": self.goals.source,
                "fitted": policy.fitted,
                "reward_learned": self.goals.learned,
                "num_timesteps": self.num_timesteps,
                "n_envs": getattr(self, "n_envs", 1),
                "n_updates": self._n_updates,
            }
        return AgentState(data, arrays)

    @classmethod
    def from_state(cls, state: AgentState, env: GymEnv | None = None, *, reward: RewardFn | None = None, **kwargs: Any) -> Self:
        """An agent restored from its ``state``.

        Args:
            state: see ``state``.
            env: an environment with the same spaces, or None.
            reward: the goal; needed again if it was a custom one.
            **kwargs: constructor arguments that override those of the state.

        Raises:
            TypeError, ValueError: an unknown argument, an environment with other spaces, or weights that do not fit.
        """
        check_overrides(cls.__init__, kwargs)
        data = state.data
        arguments = {**data["settings"], "learning_rate": data["learning_rate"], "model": data["model"]}
        arguments |= {"exploration": data["exploration"], **kwargs}
        agent = cls(data["policy_class"], env=None, _init_setup_model=False, **arguments)
        agent.observation_space, agent.action_space = (
            space_from_json(data[f"{name}_space"]) for name in ("observation", "action")
        )
        if kwargs.get("seed") is None:
            agent._planning_seed = int(data["planning_seed"])
        agent.n_envs = int(data["n_envs"])
        if env is not None:
            wrapped = cls._wrap_env(env, agent.verbose)
            check_for_correct_spaces(wrapped, agent.observation_space, agent.action_space)
            agent.env, agent.n_envs = wrapped, wrapped.num_envs
        agent._setup_model()
        agent.num_timesteps, agent._n_updates = int(data["num_timesteps"]), int(data["n_updates"])
        agent._restore(state, reward)
        return agent

    def _restore(self, state: AgentState, reward: RewardFn | None) -> None:
        """Restores weights, start states, transitions and goal from a state."""
        self._recode(self.policy.factored.from_value_arrays(state.arrays["policy"]))
        policy, fitted = self.policy, bool(state.data["fitted"])
        policy.start_states = state.start_states(np.asarray(policy.factored.cardinalities))
        if (rows := state.transitions) is not None:
            self.experience.dataset.append(rows)
        if fitted:
            policy.transition_model.load_state_dict(state.weights("model."))
            policy.reward_model.load_state_dict(state.weights("reward."))
            policy.fitted = True
        self.goals.learned = bool(state.data["reward_learned"])
        policy.refresh()
        if reward is not None:
            self.set_reward(reward)
        elif fitted or state.data["reward_source"] == "custom":
            policy.set_goal(self.goals.restore(state.data["reward_source"]))

    def save(  # type: ignore[override]
        self, path: Target, exclude: Sequence[str] | None = None, include: Sequence[str] | str | None = None
    ) -> None:
        """Writes settings, weights, start states and the learned reward to a zip without code (see ``checkpoint``).

        Args:
            path: a path (".zip" is added if it has no suffix) or an open binary file.
            exclude: accepted for compatibility with SB3; ignored.
            include: ``"transitions"`` or ``["transitions"]`` to include the observed transitions.

        Raises:
            ValueError: the model or exploration cannot be rebuilt from a file, or ``include`` names anything else.
            TypeError: ``path`` is neither a path nor an open binary file.
            OSError: the file cannot be written; an existing file is unchanged.
        """
        del exclude
        names = [include] if isinstance(include, str) else include or ()
        if unknown := [name for name in names if name != "transitions"]:
            raise ValueError(f"include takes 'transitions' only, got {unknown[0]!r}; everything else is always saved.")
        checkpoint.write(path, self.state(transitions="transitions" in names))

    @classmethod
    def load(  # type: ignore[override]
        cls,
        path: Target,
        env: GymEnv | None = None,
        device: torch.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        reward: RewardFn | None = None,
        **kwargs: Any,
    ) -> Self:
        """An agent from a file written by ``save``; no code in the file is ever run.

        Args:
            path: a path or an open binary file.
            env: a new environment, with the same spaces.
            device: torch device.
            custom_objects: accepted for compatibility with SB3; ignored, since files contain no objects to replace.
            print_system_info: as in SB3.
            force_reset: whether ``learn`` starts with a reset.
            reward: the goal; needed again if it was a custom one.
            **kwargs: constructor arguments that override the saved ones.

        Raises:
            FileNotFoundError, TypeError, ValueError: there is no such file, or ``path`` is not a path or not a saved agent.
        """
        del custom_objects
        if print_system_info:
            get_system_info()
        agent = cls.from_state(checkpoint.read(path), env, reward=reward, device=device, **kwargs)
        if force_reset:
            agent._last_obs = None
        return agent

    def set_parameters(
        self,
        load_path_or_dict: str | Mapping[str, Any],
        exact_match: bool = True,
        device: torch.device | str = "auto",
    ) -> None:
        """Loads weights from a saved agent or from ``get_parameters``; planning caches are cleared, the goal is kept."""
        params = load_path_or_dict
        if not isinstance(params, Mapping):
            params = {"policy": checkpoint.read(params).arrays["policy"]}
        with self.policy.lock:
            before = self.policy.parts()
            try:
                weights = params.get("policy", {})
                self._recode(self.policy.factored.from_value_arrays({k: np.asarray(v) for k, v in dict(weights).items()}))
                super().set_parameters(dict(params), exact_match, device)
            except Exception:
                if before[0] is not self.policy.factored:
                    self.policy.recode(*before)
                    self.goals.recode()
                    self._refresh()
                raise
            self._refresh()

    def save_transitions(self, path: Target) -> None:
        """Writes the observed transitions as an ``.npz`` of plain arrays; argument and errors: see TransitionDataset.save."""
        self.experience.dataset.save(path)

    def load_transitions(self, path: Target) -> None:
        """Adds transitions from a file to this agent's experience; the next ``learn`` includes them in the fit.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file contains no transitions, or those of another environment; the agent is unchanged.
        """
        self.experience.dataset.take(TransitionDataset.load(path))
