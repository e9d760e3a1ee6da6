"""Updates of plain networks on the CPU by compiled kernels instead of torch's autograd."""

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from torch import nn

from sb3_rainbow.fast import mlp_kernels as kernels
from sb3_rainbow.fast.flat_parameters import FlatParameters
from sb3_rainbow.network.noisy_linear import NoisyLinear
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.type_aliases import Batch

# Options of torch's Adam that adam_step does not know
_UNKNOWN_TO_KERNELS = ("amsgrad", "maximize", "decoupled_weight_decay")
# What an extractor may consist of. The kernels let the online network's serve the target too, and
# call it as often as suits them: nothing in it may change, learn or draw random numbers.
_STATELESS = (FlattenExtractor, CombinedExtractor, nn.ModuleDict, nn.Flatten)
# Below any probability that float32 holds as a normal number
_TINY = float(np.finfo(np.float32).tiny)
_NO_MASKS = np.zeros((0, 0), dtype=np.bool_)


class MlpUpdate:
    """
    What :class:`~sb3_rainbow.learner.learner.Learner` does, for ReLU perceptrons on the CPU.

    An update of a small network is mostly overhead: some hundred tensor operations, each with its
    allocation and its autograd node. Here it is a few compiled calls on the memory of torch's own
    tensors, which stay the one place where parameters, noise and Adam's moments live. The head is
    evaluated for the action that counts, where torch would compute all.

    :param q_net: online network
    :param q_net_target: target network
    :param flat: parameters of the online network
    :param flat_target: parameters of the target network
    :param optimizer: Adam over ``flat.vector``
    """

    def __init__(
        self,
        q_net: RainbowNetwork,
        q_net_target: RainbowNetwork,
        flat: FlatParameters,
        flat_target: FlatParameters,
        optimizer: th.optim.Optimizer,
    ) -> None:
        self.q_net, self.q_net_target = q_net, q_net_target
        self.flat, self.flat_target = flat, flat_target
        self.optimizer = optimizer
        self.table = _table(q_net)
        n_in, n_out = self.table[-1, [kernels.INPUTS, kernels.OUTPUTS]]
        n_effective = int(self.table[-1, kernels.EFFECTIVE] + (n_in + 1) * n_out)
        self._effective, self._effective_target, self._gradient = (
            np.zeros(n_effective, np.float32) for _ in range(3)
        )
        self._capacity = 0
        self._common, self._common_target = (
            np.zeros((q_net.n_atoms, n_in), np.float32) for _ in range(2)
        )
        self._common_bias, self._common_bias_target = (
            np.zeros(q_net.n_atoms, np.float32) for _ in range(2)
        )

    def _reserve(self, batch_size: int) -> None:
        """Scratch for batches up to this size: fresh pages at every update would cost more."""
        if batch_size <= self._capacity:
            return
        self._capacity = batch_size
        n_hidden = batch_size * int(self.table[:-1, kernels.OUTPUTS].sum())
        self._hidden, self._hidden_next, self._hidden_target = (
            np.empty(n_hidden, np.float32) for _ in range(3)
        )
        n_logits = self.q_net.n_actions * self.q_net.n_atoms
        self._logits = np.empty((batch_size, n_logits), np.float32)
        self._value = np.empty((batch_size, self.q_net.n_atoms), np.float32)

    @staticmethod
    def is_possible(
        q_net: RainbowNetwork, flat: FlatParameters | None, optimizer: th.optim.Optimizer
    ) -> bool:
        """Whether it is a ReLU perceptron on flat float32 inputs on the CPU, trained by Adam."""
        group = optimizer.param_groups[0]
        return (
            flat is not None
            and flat.vector.device.type == "cpu"
            and flat.vector.dtype == th.float32
            and type(q_net) is RainbowNetwork
            and type(q_net.activation) is nn.ReLU
            and all(type(module) in _STATELESS for module in q_net.features_extractor.modules())
            and type(optimizer) is th.optim.Adam
            and [id(p) for p in group["params"]] == [id(flat.vector)]
            and not any(group[name] for name in _UNKNOWN_TO_KERNELS)
        )

    def update(
        self, batch: Batch, double_q: bool, max_grad_norm: float
    ) -> tuple[th.Tensor, th.Tensor]:
        """As ``Learner.update``, with the noise that the networks hold."""
        obs, next_obs = self._features(batch.observations), self._features(batch.next_observations)
        n = obs.shape[0]
        weights = np.ones(n, np.float32) if batch.weights is None else batch.weights.numpy()
        slope, losses, priorities = self._slopes(batch, obs, next_obs, weights, double_q)
        kernels.backward(
            self._effective,
            self.table,
            obs,
            self._hidden,
            self._actions,
            self.q_net.dueling,
            self._common,
            slope,
            self._gradient,
        )
        assert self.flat.vector.grad is not None
        kernels.parameter_gradients(
            self._gradient, self.q_net.noise.numpy(), self.table, self.flat.vector.grad.numpy()
        )
        self._step(max_grad_norm)
        return th.tensor(float(losses @ weights) / n), th.from_numpy(priorities)

    def act(self, obs: th.Tensor, action_masks: NDArray[np.bool_] | None) -> NDArray[np.int64]:
        """
        Greedy actions of the online network under its current noise.

        :param obs: observations, ``(n_envs, ...)``
        :param action_masks: True where allowed, ``(n_envs, n_actions)``
        :return: shape ``(n_envs,)``
        """
        features = self._features(obs)
        self._reserve(features.shape[0])
        kernels.effective_weights(
            self.flat.vector.detach().numpy(), self.q_net.noise.numpy(), self.table, self._effective
        )
        units = kernels.hidden_units(self._effective, self.table, features, self._hidden)
        masks = _NO_MASKS if action_masks is None else action_masks
        return self._best_actions(self._effective, units, masks)

    def _features(self, obs: th.Tensor | dict[str, th.Tensor]) -> NDArray[np.float32]:
        with th.no_grad():
            features = self.q_net.extract_features(obs, self.q_net.features_extractor)
        return features.contiguous().numpy()

    def _slopes(
        self,
        batch: Batch,
        obs: NDArray[np.float32],
        next_obs: NDArray[np.float32],
        weights: NDArray[np.float32],
        double_q: bool,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Slope of the weighted mean loss in the taken logits, losses and priorities."""
        net, table, n = self.q_net, self.table, obs.shape[0]
        self._reserve(n)
        online, target = self._effective, self._effective_target
        kernels.effective_weights(
            self.flat.vector.detach().numpy(), net.noise.numpy(), table, online
        )
        kernels.effective_weights(
            self.flat_target.vector.detach().numpy(),
            self.q_net_target.noise.numpy(),
            table,
            target,
        )
        units_target = kernels.hidden_units(target, table, next_obs, self._hidden_target)
        if double_q:
            chooser, units_next = (
                online,
                kernels.hidden_units(online, table, next_obs, self._hidden_next),
            )
        else:
            chooser, units_next = target, units_target
        masks = batch.next_action_masks
        next_actions = self._best_actions(
            chooser, units_next, _NO_MASKS if masks is None else masks.numpy()
        )
        units = kernels.hidden_units(online, table, obs, self._hidden)
        self._actions = batch.actions[:, 0].numpy()
        logits = self._taken(online, units, self._actions, self._common, self._common_bias)
        target_logits = self._taken(
            target, units_target, next_actions, self._common_target, self._common_bias_target
        )
        slope, losses = np.empty_like(logits), np.empty(n, np.float32)
        returns, discounts = batch.rewards.numpy(), batch.discounts.numpy()
        dones = batch.dones.numpy()
        priorities = np.empty(n, np.float32)
        if net.distributional:
            target = np.empty_like(logits)
            kernels.projected_target(
                _exponential(target_logits),
                *(returns, discounts, dones),
                *(net.v_min, net.v_max),
                target,
            )
            log_target = th.from_numpy(target).clamp(min=_TINY).log_().numpy()
            masses = _exponential(logits)
            kernels.categorical_slopes(
                logits, masses, target, log_target, weights, losses, priorities, slope
            )
        else:
            kernels.huber_slopes(
                logits, target_logits, returns, discounts, dones, weights, losses, priorities, slope
            )
        return slope, losses, priorities

    def _best_actions(
        self,
        effective: NDArray[np.float32],
        units: NDArray[np.float32],
        masks: NDArray[np.bool_],
    ) -> NDArray[np.int64]:
        net, n = self.q_net, units.shape[0]
        logits = self._logits[:n]
        kernels.all_logits(effective, self.table, units, net.dueling, self._value[:n], logits)
        if net.distributional:
            th.from_numpy(logits).exp_()
        actions = np.empty(n, np.int64)
        kernels.best_actions(logits, net.support.numpy(), masks, actions)
        return actions

    def _taken(
        self,
        effective: NDArray[np.float32],
        units: NDArray[np.float32],
        actions: NDArray[np.int64],
        common: NDArray[np.float32],
        common_bias: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        net = self.q_net
        logits = np.empty((units.shape[0], net.n_atoms), np.float32)
        kernels.shared_weight(effective, self.table, net.n_atoms, net.dueling, common, common_bias)
        kernels.taken_logits(
            effective, self.table, units, actions, net.dueling, common, common_bias, logits
        )
        return logits

    def _step(self, max_grad_norm: float) -> None:
        """Adam in place on the optimizer's own state, so that saving and loading see it."""
        vector = self.flat.vector
        state = self.optimizer.state[vector]
        if not state:
            # torch creates its state with the first step.
            th.nn.utils.clip_grad_norm_([vector], max_grad_norm)
            self.optimizer.step()
            return
        group = self.optimizer.param_groups[0]
        state["step"] += 1
        beta1, beta2 = group["betas"]
        assert vector.grad is not None
        kernels.adam_step(
            vector.detach().numpy(),
            vector.grad.numpy(),
            state["exp_avg"].numpy(),
            state["exp_avg_sq"].numpy(),
            max_grad_norm,
            float(group["lr"]),
            float(beta1),
            float(beta2),
            float(group["eps"]),
            float(group["weight_decay"]),
            float(state["step"]),
        )


def _exponential(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """
    Exponentials of logits, which are shifted to a maximum of 0 in place.

    Torch's are vectorized, and several times faster than those of a compiled loop.
    """
    kernels.shift_to_zero(logits)
    return th.from_numpy(logits).exp().numpy()


def _table(net: RainbowNetwork) -> NDArray[np.int64]:
    """Where each layer lies; see :mod:`sb3_rainbow.fast.mlp_kernels`."""
    rows = []
    parameters = noise = effective = hidden = 0
    for layer in net.layers:
        assert isinstance(layer, NoisyLinear | nn.Linear)
        noisy = isinstance(layer, NoisyLinear)
        n_in, n_out = layer.in_features, layer.out_features
        rows.append([n_in, n_out, int(noisy), parameters, noise, effective, hidden])
        size = (n_in + 1) * n_out
        parameters += 2 * size if noisy else size
        noise += n_in + n_out if noisy else 0
        effective += size
        hidden += n_out
    return np.asarray(rows, dtype=np.int64)
