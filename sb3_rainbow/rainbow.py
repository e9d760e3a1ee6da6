"""Rainbow on Stable-Baselines3."""

import warnings
from typing import Any, ClassVar, Self

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule, TensorDict
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_rainbow import settings
from sb3_rainbow.learner.learner import Learner, as_batch, flush_denormals
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, RainbowPolicy
from sb3_rainbow.replay.buffers import PrioritizedReplayBuffer
from sb3_rainbow.replay.parameters import check_buffer_size, smallest_buffer
from sb3_rainbow.resume.resumable import ResumableAlgorithm, refuse_checkpoint
from sb3_rainbow.type_aliases import Distributional, ObsArray, SaveFile, UseMasking

# Share of the targets' mass beyond the support from which on a warning is due. Before anything is
# learned a tenth may lie there
_CLIPPED_TO_WARN = 0.3
# Updates between two looks at what only the logs need
_DIAGNOSTICS_INTERVAL = 100
_MISSING_MASKS = (
    "The model was trained under action masks and is asked for actions without them, so it may "
    "choose what the env forbids: pass predict(action_masks=...), and evaluate with "
    "sb3_contrib.common.maskable.evaluation.evaluate_policy and "
    "sb3_contrib.common.maskable.callbacks.MaskableEvalCallback"
)


class Rainbow(ResumableAlgorithm):
    """Rainbow DQN (Hessel et al. 2018, https://arxiv.org/abs/1710.02298) with action masks.

    Six extensions of DQN, each of which can be off: ``double_q``, ``dueling``, ``prioritized``,
    ``n_steps`` (off: 1), ``noisy`` (off: epsilon-greedy alone), ``distributional`` (off: Huber loss
    on scalar Q-values). The arguments up to ``device`` are those of SB3's ``DQN``, in its order.

    The defaults are for small tasks, of some ten thousand steps: a higher rate that falls, more
    updates and a target that follows sooner than in Hessel et al., quantiles, which need no
    support, and a little epsilon, as noise alone tries some actions too seldom. ``Rainbow(...,
    **sb3_rainbow.HESSEL)`` has theirs, which are for 200 million frames of Atari and learn nothing
    on small tasks.

    Args:
        policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy", or a policy class.
        learning_rate: learning rate, or a function of the remaining progress (from 1 to 0).
            ``None`` (default) falls linearly in each call of ``learn``, in the first from 1e-3 to
            1e-4; with ``CnnPolicy`` it is 1e-4. Give a number if you train in many calls.
        buffer_size: transitions in the replay buffer, over all envs.
        learning_starts: steps of random (allowed) actions before learning starts.
        batch_size: transitions per update.
        tau: Polyak coefficient of the target network, 1 for a copy. ``None`` (default) is 0.005, or
            with a ``target_update_interval`` SB3's 1.
        gamma: discount factor.
        train_freq: steps between two rounds of updates, or a tuple such as ``(2, "episode")``.
        gradient_steps: updates per round; -1 for as many as steps were taken.
        replay_buffer_class: ``None`` for ``PrioritizedReplayBuffer``. SB3's own buffers,
            ``HerReplayBuffer`` included, keep no priorities; of them ``NStepReplayBuffer`` alone
            keeps n-step returns.
        replay_buffer_kwargs: more keyword arguments for the buffer.
        optimize_memory_usage: for SB3's buffers; the default one always stores each observation
            once.
        n_steps: rewards per return. ``None`` (default) is 3, or with a buffer that keeps no n-step
            returns 1, with a warning.
        target_update_interval: ``None`` (default) moves the target network by ``tau`` after every
            update; a number does so every that many steps of the env, as SB3's DQN.
        exploration_fraction: fraction of training over which epsilon falls.
        exploration_initial_eps: epsilon at the start. With this and the next at 0 there is no
            epsilon beside the noise.
        exploration_final_eps: epsilon at the end.
        max_grad_norm: gradient norm to clip to, None for no clipping.
        stats_window_size: episodes to average the logged statistics over.
        policy_kwargs: arguments of the policy, such as ``net_arch``, ``noisy_layers``,
            ``optimizer_kwargs=dict(weight_decay=1e-5)``.
        seed: seed of all random generators.
        double_q: choose the action at t + n with the online network.
        dueling: value and advantage streams.
        prioritized: draw transitions by the size of their errors; uniformly if False. ``None``
            (default) is True, or with a buffer that keeps no priorities False, with a warning.
        noisy: explore by noisy layers.
        distributional: learn the distribution of returns: ``"quantile"`` as ``n_atoms`` quantiles,
            which need no support (QR-DQN's), ``"categorical"`` or True over ``n_atoms`` values from
            ``v_min`` to ``v_max`` (Hessel et al.'s), False not at all. ``None`` (default) is
            ``"categorical"`` where ``v_min`` and ``v_max`` are given, ``"quantile"`` elsewhere.
        n_atoms: atoms of the support, or quantiles.
        v_min: lowest return of the categorical head's support. It and ``v_max`` are given both, or
            neither: then they are -100 and 100, which fit rewards in [-1, 1] and gamma 0.99.
        v_max: highest return of the support.
        sigma0: initial scale of the noisy layers.
        alpha: exponent of the priorities.
        beta_start: importance-sampling exponent at the start of training.
        beta_end: the same at the end; linear in between.
        use_masking: "auto" uses ``action_masks()`` where the env has it.
        cpu_kernels: update ReLU perceptrons on the CPU by compiled kernels, in a sixth to a third
            of the time of torch's operations.

    Raises:
        ValueError: for parameters out of range, or combinations that cannot work.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    exploration_schedule: Schedule
    _warned_of_missing_masks: bool = False
    q_net: RainbowNetwork
    q_net_target: RainbowNetwork
    policy: RainbowPolicy

    def __init__(
        self,
        policy: str | type[RainbowPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule | None = None,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 128,
        tau: float | None = None,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 4,
        gradient_steps: int = 4,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int | None = None,
        target_update_interval: int | None = None,
        exploration_fraction: float = 0.1,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        max_grad_norm: float | None = 10.0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        double_q: bool = True,
        dueling: bool = True,
        prioritized: bool | None = None,
        noisy: bool = True,
        distributional: Distributional | None = None,
        n_atoms: int = 51,
        v_min: float | None = None,
        v_max: float | None = None,
        sigma0: float = 0.1,
        alpha: float = 0.6,
        beta_start: float = 0.4,
        beta_end: float = 1.0,
        use_masking: UseMasking = "auto",
        cpu_kernels: bool = True,
        _init_setup_model: bool = True,
    ) -> None:
        self._tau_was_chosen = tau is not None
        prioritized, n_steps = settings.served_by(replay_buffer_class, prioritized, n_steps)
        super().__init__(
            policy,
            env,
            learning_rate,  # type: ignore[arg-type]  # of None _setup_model makes a rate
            buffer_size,
            learning_starts,
            batch_size,
            tau,  # type: ignore[arg-type]  # and so here
            gamma,
            train_freq,
            gradient_steps,
            action_noise=None,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            supported_action_spaces=(spaces.Discrete,),
            support_multi_env=True,
        )
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_fraction = exploration_fraction
        self.exploration_rate = 0.0
        self.target_update_interval = target_update_interval
        self.max_grad_norm = max_grad_norm
        self.double_q = double_q
        self.dueling = dueling
        self.prioritized = prioritized
        self.noisy = noisy
        head = settings.head_and_support(distributional, v_min, v_max)
        self.distributional, self.v_min, self.v_max = head
        self.n_atoms = n_atoms
        self.sigma0 = sigma0
        self.alpha = alpha
        self.beta_start = beta_start
        self.beta_end = beta_end
        self.use_masking = settings.as_use_masking(use_masking)
        self.cpu_kernels = cpu_kernels

        self._n_calls = 0
        self._warned_of_support = False
        # Saved with the model: what its weights were trained for
        self._support: tuple[float, ...] | None = None
        if _init_setup_model:
            # Not when a model is loaded: who only predicts needs no room for training.
            check_buffer_size(buffer_size, self.n_envs, n_steps)
            self._setup_model()

    def _setup_model(self) -> None:
        given = vars(self)  # None, also where load was given it, is the default
        if given["tau"] is None:
            self.tau = settings.default_tau(self.target_update_interval)
        if given["learning_rate"] is None:  # for images SB3's: ours was searched on perceptrons
            falling = LinearSchedule(1e-3, 1e-4, end_fraction=1.0)
            self.learning_rate = 1e-4 if issubclass(self.policy_class, CnnPolicy) else falling
        had_quantiles = given["distributional"] is None and self._support in ((), [])
        ends = (None, None) if had_quantiles else (self.v_min, self.v_max)
        head = settings.head_and_support(self.distributional, *ends)
        self.distributional, self.v_min, self.v_max = head
        settings.check_settings(self)
        self.prioritized, self.n_steps = settings.served_by(
            self.replay_buffer_class, self.prioritized, self.n_steps
        )
        self.use_masking = settings.as_use_masking(self.use_masking)
        self._support = settings.support_of(*head)
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.exploration_schedule = LinearSchedule(
            self.exploration_initial_eps, self.exploration_final_eps, self.exploration_fraction
        )
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            **{name: getattr(self, name) for name in settings.NETWORK_ARGUMENTS},
            **self.policy_kwargs,
        ).to(self.device)
        self._convert_train_freq()
        self._create_aliases()
        # As SB3's PPO and A2C: a GPU waits for each of a small network's many operations.
        flat = isinstance(getattr(self.q_net, "features_extractor", None), FlattenExtractor)
        if flat and self.device.type != "cpu":
            warnings.warn(
                f"{type(self).__name__} with a small network is slower on {self.device.type} "
                "than on the CPU: pass device='cpu', or set CUDA_VISIBLE_DEVICES to nothing",
                stacklevel=3,
            )

    def _make_replay_buffer(self) -> ReplayBuffer:
        if self.replay_buffer_class is None:
            self.replay_buffer_class = PrioritizedReplayBuffer
        buffer_class, size = self.replay_buffer_class, self.buffer_size
        kwargs = dict(self.replay_buffer_kwargs)
        if issubclass(buffer_class, PrioritizedReplayBuffer | NStepReplayBuffer):
            kwargs = {"n_steps": self.n_steps, "gamma": self.gamma, **kwargs}
        if issubclass(buffer_class, PrioritizedReplayBuffer):
            self.optimize_memory_usage = False  # or SB3 would warn of what its own buffer does
            kwargs.setdefault("alpha", self.alpha if self.prioritized else 0.0)
            size = max(size, smallest_buffer(self.n_envs, kwargs["n_steps"]))
        if issubclass(buffer_class, HerReplayBuffer):
            assert self.env is not None, "You must pass an environment when using HerReplayBuffer"
            kwargs["env"] = self.env
        return buffer_class(
            size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **kwargs,
        )

    def _create_aliases(self) -> None:
        self.q_net = self.policy.q_net
        self.q_net_target = self.policy.q_net_target
        self._learner = Learner(self.policy, self.double_q, self.max_grad_norm, self.cpu_kernels)

    def predict(
        self,
        observation: ObsArray,
        state: tuple[NDArray, ...] | None = None,
        episode_start: NDArray | None = None,
        deterministic: bool = False,
        action_masks: NDArray | None = None,
    ) -> tuple[NDArray, tuple[NDArray, ...] | None]:
        """Actions for one observation or a batch.

        Unless ``deterministic``, the policy explores, each env for itself: with fresh noise in its
        noisy layers, and by a random allowed action with probability ``exploration_rate``.

        Args:
            observation: one observation or a batch.
            state: passed through, as in SB3's policies that are not recurrent.
            deterministic: greedy actions of the mean weights.
            action_masks: True where allowed, ``(n_actions,)`` or ``(n_envs, n_actions)``.

        Returns:
            actions, and ``state``.

        Raises:
            ValueError: for masks of another shape, or with a row that allows nothing.
        """
        if action_masks is None and self._masking and not self._warned_of_missing_masks:
            self._warned_of_missing_masks = True
            warnings.warn(_MISSING_MASKS, stacklevel=2)
        # A subclass for envs without masks may have the signature of SB3's.
        masks: dict[str, Any] = {} if action_masks is None else {"action_masks": action_masks}
        actions, state = self.policy.predict(
            observation, state, episode_start, deterministic, **masks
        )
        if self.exploration_rate > 0.0 and not deterministic:
            actions = self._epsilon_greedy(actions, self.exploration_rate, action_masks)
        return actions, state

    def _explore(self, obs: ObsArray, action_masks: NDArray[np.bool_] | None) -> NDArray:
        own = type(self).predict is Rainbow.predict and "predict" not in vars(self)
        if own and self.noisy and isinstance(obs, np.ndarray):
            obs_tensor, _ = self.policy.obs_to_tensor(obs)
            assert isinstance(obs_tensor, th.Tensor)
            actions = self._learner.act(obs_tensor, action_masks)
            if actions is not None:
                epsilon = self.exploration_rate
                return self._epsilon_greedy(actions, epsilon, action_masks) if epsilon else actions
        return super()._explore(obs, action_masks)

    def _on_step(self) -> None:
        self._n_calls += 1
        interval = self.target_update_interval
        if interval is not None and self._n_calls % max(interval // self.n_envs, 1) == 0:
            self._learner.move_target(self.tau)
        self.exploration_rate = self.exploration_schedule(self._current_progress_remaining)
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    @property
    def beta(self) -> float:
        """Importance-sampling exponent at the present progress of training."""
        progress = min(max(1.0 - self._current_progress_remaining, 0.0), 1.0)
        return self.beta_start + progress * (self.beta_end - self.beta_start)

    def train(self, gradient_steps: int, batch_size: int = 32) -> None:
        """Update the networks ``gradient_steps`` times, by ``batch_size`` transitions each.

        A method in its place must move the target network too, or set ``target_update_interval``.
        """
        buffer = self.replay_buffer
        assert buffer is not None
        if isinstance(buffer, PrioritizedReplayBuffer):
            buffer.beta = self.beta
            buffer.gamma = self.replay_buffer_kwargs.get("gamma", self.gamma)
            if not buffer.can_sample:
                # The first n-step windows are not complete yet.
                return
        if gradient_steps < 1:
            return
        self.policy.q_net_target.set_training_mode(False)  # and modules put into it since
        self.policy.set_training_mode(True)  # and modules that both networks share
        self._update_learning_rate(self.policy.optimizer)
        learner = self._learner
        learner.double_q, learner.max_grad_norm = self.double_q, self.max_grad_norm
        tau = self.tau if self.target_update_interval is None else None
        losses: list[Any] = []  # numbers, or tensors that nobody has waited for
        with flush_denormals(), learner.undisturbed():
            for _ in range(gradient_steps):
                samples = buffer.sample(batch_size, env=self._vec_normalize_env)
                batch = as_batch(samples, self.gamma, self.use_masking is not False)
                loss, priorities = learner.update(batch, tau)
                if isinstance(buffer, PrioritizedReplayBuffer) and self.prioritized:
                    buffer.update_priorities(batch.indices, priorities.cpu().numpy())
                losses.append(loss)
        logs_due = -self._n_updates % _DIAGNOSTICS_INTERVAL < gradient_steps
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", float(sum(losses) / len(losses)))
        if self.prioritized:
            self.logger.record("train/beta", self.beta)
        if logs_due:
            values = learner.diagnostics(batch, priorities)
            for name, value in values.items():
                self.logger.record(f"train/{name}", value)
            clipped = values.get("clipped_support", 0.0)
            if clipped > _CLIPPED_TO_WARN and not self._warned_of_support:
                self._warned_of_support = True
                warnings.warn(
                    f"{100 * clipped:.0f} % of the returns lie outside of the support "
                    f"[{self.v_min}, {self.v_max}]: pass a wider v_min and v_max, or "
                    'distributional="quantile", which needs none',
                    stacklevel=2,
                )

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "Rainbow",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        *,
        use_masking: UseMasking | None = None,
    ) -> Self:
        """As SB3's ``learn``; ``use_masking`` overrides the constructor's from here on.

        Raises:
            ValueError: for masks that the env or the buffer cannot serve.
        """
        if use_masking is not None:
            self.use_masking = settings.as_use_masking(use_masking)
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )

    @classmethod
    def load(
        cls,
        path: SaveFile,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """As SB3's ``load``.

        A new ``target_update_interval`` brings its own default ``tau``, unless one was chosen when
        the model was made, or is given now. A ``seed`` wins over the saved random generators. A too
        small ``buffer_size`` is raised to the smallest legal one: pass 1 if you only predict.
        """
        given = {**(custom_objects or {}), **kwargs}
        if "seed" in given:
            kwargs["seed"] = given["seed"]
        if "tau" in given:
            kwargs["_tau_was_chosen"] = given["tau"] is not None
        model = super().load(
            path, env, device, custom_objects, print_system_info, force_reset, **kwargs
        )
        if "target_update_interval" in given and not model._tau_was_chosen:
            model.tau = settings.default_tau(model.target_update_interval)
        return model

    def set_parameters(
        self,
        load_path_or_dict: str | TensorDict,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """As SB3's ``set_parameters``.

        Raises:
            SettingsMismatchError: if the parameters are of other shapes, or a file of a model with
                another support.
        """
        if not isinstance(load_path_or_dict, dict):
            refuse_checkpoint(load_path_or_dict)
            support = settings.support_in_file(load_path_or_dict)
            settings.check_support_of_file(support, self._support)
        try:
            super().set_parameters(load_path_or_dict, exact_match, device)
        except RuntimeError as error:
            raise settings.SettingsMismatchError(
                f"The checkpoint was saved with other settings than the model's: {error}"
            ) from error

    def _excluded_save_params(self) -> list[str]:
        own = ("q_net", "q_net_target", "_learner", "_warned_of_missing_masks")
        return [*super()._excluded_save_params(), *own]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []
