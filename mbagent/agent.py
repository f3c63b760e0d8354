"""The agent: it explores, fits a transition model to what it observed, and plans."""

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
from mbagent.checkpoint import SETTINGS, AgentState, space_from_json, space_to_json
from mbagent.data import Experience, ExperienceRecorder, TransitionDataset, distinct_rows, warn_of_forgetting
from mbagent.environments import EnvironmentAlgorithm, step
from mbagent.explain import Explanation, explain
from mbagent.exploration.strategies import EXPLORATIONS, Exploration, Watching, catch_up
from mbagent.files import Target
from mbagent.models.base import FitReport
from mbagent.models.neural.connections import PruningConfig, check_fraction, prunable
from mbagent.models.protocol import TransitionModel
from mbagent.models.registry import build_model
from mbagent.models.reward import LearnedReward
from mbagent.policies import FlatMonteCarloPolicy, MctsPolicy, PlannerPolicy, ValueIterationPolicy
from mbagent.rewards import RewardFn, RewardSelector
from mbagent.spaces import ActionEnumeration, FactoredSpace
from mbagent.training_log import check_progress, fit_progress, log_fit, log_rollout

ITERATION_STEPS = 1000
"""Environment steps between two looks at the logger."""

EXPLORING = 0xE8
"""Salt of the random numbers of exploration: an environment with the same seed must not draw the same ones."""

MAX_START_STATES = 512
"""Start states kept for generating the reachable machine."""


class ModelLearningAgent(EnvironmentAlgorithm):
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
        fraction = check_fraction(fraction)
        model = prunable(self.model, self.policy.fitted, len(self.experience.dataset))
        with self.policy.lock, fit_progress(progress_bar) as progress:
            report = model.prune(self.transitions, fraction, seed=self._planning_seed, progress=progress, config=config)
            self._n_updates += 1
            self.fit_report = report
            self._refresh()
        if hasattr(self, "_logger"):  # a loaded agent has none before it learns
            log_fit(self.logger, report, self._n_updates, len(self.transitions), len(self.policy.start_states))
        return self

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Changes the environment (same spaces); without a custom reward the goal becomes the new environment's."""
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
            ValueError: the model, the exploration or the policy is an object, which data cannot rebuild.
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
                self.goals.fit_learned()  # a loaded agent without an environment plans for it
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
        """The agent that a state was taken from.

        Args:
            state: see ``state``.
            env: an environment with the same spaces, or None.
            reward: the goal; needed again if it was a custom one.
            **kwargs: constructor arguments that override those of the state.

        Raises:
            TypeError, ValueError: an unknown argument, other spaces, or weights that do not fit.
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
        """Takes weights, start states, transitions and goal from a state."""
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
        """Writes settings, weights, start states and the learned reward to a zip that holds no code (see ``checkpoint``).

        Args:
            path: a path (".zip" is added where there is no suffix) or an open binary file.
            exclude: accepted as in SB3; nothing here can be left out.
            include: ``"transitions"``, or a list of it, adds the observed transitions.

        Raises:
            ValueError: the model or the exploration is an object that a file cannot rebuild, or ``include`` names anything else.
            TypeError: ``path`` is neither a path nor an open binary file.
            OSError: the file cannot be written; one that was there before is unchanged.
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
        """The agent that ``save`` wrote; no code in the file is ever run.

        Args:
            path: where it was written.
            env: a new environment, with the same spaces.
            device: torch device.
            custom_objects: accepted as in SB3; files hold no objects that could be replaced.
            print_system_info: accepted as in SB3.
            force_reset: whether ``learn`` starts with a reset.
            reward: the goal; needed again if it was a custom one.
            **kwargs: constructor arguments that override the saved ones.

        Raises:
            FileNotFoundError, TypeError, ValueError: no such file, no path at all, or no saved agent.
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
        """Takes weights from a saved agent or from ``get_parameters``; planning caches are dropped, the goal stays."""
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
        """Writes what was experienced as an ``.npz`` of plain arrays (see TransitionDataset.save, also for what it raises)."""
        self.experience.dataset.save(path)

    def load_transitions(self, path: Target) -> None:
        """Takes transitions from a file into this agent's experience; the next ``learn`` fits to them too.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it holds no transitions, or those of another kind of environment; nothing is changed then.
        """
        self.experience.dataset.take(TransitionDataset.load(path))
