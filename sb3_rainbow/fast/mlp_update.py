"""Updates of plain networks on the CPU by compiled kernels instead of torch's autograd."""

from collections.abc import Iterator
from contextlib import contextmanager
from operator import is_
from typing import TypeAlias

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_rainbow.fast import learning_kernels
from sb3_rainbow.fast import mlp_kernels as kernels
from sb3_rainbow.fast.adam import GRAD, AdamOnVector
from sb3_rainbow.fast.blas import single_blas_thread
from sb3_rainbow.fast.eligibility import parameters_of, table_of
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.network.shared_memory import join, parts, share
from sb3_rainbow.type_aliases import Batch

# Below any probability that float32 holds as a normal number
_TINY = float(np.finfo(np.float32).tiny)
_NO_MASKS = np.zeros((0, 0), dtype=np.bool_)
_ONE = np.ones(1, dtype=np.float32)
_NO_GRADIENT = np.zeros((0, 0), dtype=np.float32)
# An extractor of these parts alone has the same features for the target network, and however often
# it is called: nothing in it changes, learns or draws random numbers.
_STATELESS = (FlattenExtractor, CombinedExtractor, nn.ModuleDict, nn.Flatten)
# A network's parameters, the effective weights of its noisy layers, and the table of both
_Weights: TypeAlias = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]


class MlpUpdate:
    """What :class:`~sb3_rainbow.learner.learner.Learner` does, for ReLU perceptrons on the CPU.

    An update of a small network is mostly overhead: some hundred tensor operations, each with its
    allocation and its autograd node. Here it is a few compiled calls on the memory of torch's own
    tensors, which stay the one place where parameters, noise and Adam's moments live. The head is
    evaluated for the action that counts, where torch would compute all. What an extractor learns,
    such as convolutions, torch differentiates.

    Each network's parameters become parts of one vector, and so do their gradients.

    While it is ``settled``, an update does not look whether anyone has touched the optimizer.

    Args:
        q_net: online network.
        q_net_target: target network.
    """

    def __init__(self, q_net: RainbowNetwork, q_net_target: RainbowNetwork) -> None:
        self.q_net, self.q_net_target = q_net, q_net_target
        self._online, self._target = parameters_of(q_net), parameters_of(q_net_target)
        vectors = [join(parameters, parameters) for parameters in (self._online, self._target)]
        for parameters, vector in zip((self._online, self._target), vectors, strict=True):
            share(parameters, vector)
        gradient = th.zeros_like(vectors[0])
        self._gradients = parts(gradient, self._online)
        self._one_extractor = all(type(m) in _STATELESS for m in q_net.features_extractor.modules())
        extractors = q_net.features_extractor, q_net_target.features_extractor
        self._flattens = all(
            type(extractor) is FlattenExtractor and type(extractor.flatten) is nn.Flatten
            for extractor in extractors
        )
        self._support = q_net.support.numpy()
        n_own = len(self._online) - len(list(q_net.features_extractor.parameters()))
        self._learnt = list(zip(self._online, self._gradients, strict=True))[n_own:]
        epsilons = [*q_net.tie_noise(), *q_net_target.tie_noise()]
        self._vectors = vectors
        self._noises = q_net.noise.detach(), q_net_target.noise.detach()
        # The same memory for the kernels: to ask torch for it takes as long as to call one.
        self._values, self._drawn = ([t.numpy() for t in ts] for ts in (vectors, self._noises))
        self._gradient = gradient.numpy()
        self._shared = [*self._online, *self._target, *epsilons]
        self._addresses = [t.data_ptr() for t in self._shared]
        self._adam = AdamOnVector(self._online, vectors[0], gradient, self._gradients)
        self.table = table_of(q_net)
        n_in, n_out = self.table[-1, [kernels.INPUTS, kernels.OUTPUTS]]
        noisy = self.table[-1, kernels.NOISY]
        n_effective = int(self.table[-1, kernels.EFFECTIVE] + noisy * (n_in + 1) * n_out)
        self._effective, self._effective_target = (
            np.zeros(n_effective, np.float32) for _ in range(2)
        )
        self.settled = False
        self._capacity = 0
        self._common, self._common_target = (
            np.zeros((q_net.n_atoms, n_in), np.float32) for _ in range(2)
        )

    def _reserve(self, batch_size: int) -> None:
        """Scratch for batches up to this size: fresh pages at every update would cost more."""
        if batch_size <= self._capacity:
            return
        self._capacity = batch_size
        n_hidden = batch_size * int(self.table[:-1, kernels.OUTPUTS].sum())
        self._hidden = np.empty(2 * n_hidden, np.float32)  # of the states and of those after them
        self._hidden_target = np.empty(n_hidden, np.float32)
        n_logits = self.q_net.n_actions * self.q_net.n_atoms
        self._logits = np.empty((batch_size, n_logits), np.float32)
        n_streams = int(self.table[-1, kernels.OUTPUTS])
        self._streams = np.empty((batch_size, n_streams), np.float32)

    def is_current(self, optimizer: th.optim.Optimizer) -> bool:
        """Whether parameters and noise have the memory they had, and Adam is still Adam."""
        addresses = list(map(th.Tensor.data_ptr, self._shared))
        return addresses == self._addresses and self._adam.is_possible(optimizer, self._adam.ids)

    @contextmanager
    def undisturbed(self, optimizer: th.optim.Optimizer) -> Iterator[None]:
        """Look once, before updates that nobody disturbs, at what each would look at by itself.

        That cannot be where an extractor is someone else's: then each looks.
        """
        self.settled = self._flattens and self._adam.is_ready(optimizer)
        if self.settled:
            self._put_gradients()
        try:
            yield
        finally:
            self.settled = False

    def _put_gradients(self) -> None:
        if not all(map(is_, map(GRAD, self._online), self._gradients)):
            for p, gradient in zip(self._online, self._gradients, strict=True):
                p.grad = gradient

    @single_blas_thread()
    def update(
        self,
        batch: Batch,
        optimizer: th.optim.Optimizer,
        double_q: bool,
        max_grad_norm: float | None,
    ) -> tuple[th.Tensor, th.Tensor]:
        """As ``Learner.update``."""
        for noise, drawn in zip(self._noises, self._drawn, strict=True):
            noise.normal_()
            kernels.scale_noise(drawn[None], self.table)
        n = batch.actions.shape[0]
        weights = batch.weights.numpy()
        slope, losses, priorities = self._slopes(batch, weights, double_q)
        obs = self._obs
        learns = self._obs_features.requires_grad
        input_gradient = np.empty_like(obs) if learns else _NO_GRADIENT
        learning_kernels.backward(
            self._values[0],
            self._effective,
            self.table,
            obs,
            self._hidden,
            self._n_seen,
            self._actions,
            self.q_net.dueling,
            self._common,
            slope,
            self._gradient,
            input_gradient,
        )
        learning_kernels.sigma_gradients(self._gradient, self._drawn[0], self.table)
        if self.settled:
            self._adam.step_when_ready(optimizer, max_grad_norm)
        else:
            self._put_gradients()
            self._learn_extractor(input_gradient if learns else None)
            self._adam.step(optimizer, max_grad_norm)
        del self._obs_features
        mean = np.asarray(float(losses @ weights) / n, np.float32)
        return th.from_numpy(mean), th.from_numpy(priorities)

    def _learn_extractor(self, input_gradient: NDArray[np.float32] | None) -> None:
        for p, _ in self._learnt:
            p.grad = None
        if input_gradient is not None:
            self._obs_features.backward(th.from_numpy(input_gradient))
        for p, gradient in self._learnt:
            if p.grad is None:  # not all of an extractor need have learned
                gradient.zero_()
            else:
                p.grad = gradient.copy_(p.grad)

    @single_blas_thread()
    def act(self, obs: th.Tensor, action_masks: NDArray[np.bool_] | None) -> NDArray[np.int64]:
        """Greedy actions of the online network under fresh noise, each environment's its own.

        Args:
            obs: observations, ``(n_envs, ...)``.
            action_masks: True where allowed, ``(n_envs, n_actions)``.

        Returns:
            shape ``(n_envs,)``.
        """
        features = self._features(self.q_net, obs)
        n, noise, drawn = features.shape[0], self._noises[0], self._drawn[0]
        self._reserve(n)
        if n > 1:
            noise = noise.new_empty(n * len(noise))
            drawn = noise.numpy()
        noise.normal_()
        rows = drawn.reshape(n, len(self._drawn[0]))
        kernels.scale_noise(rows, self.table)
        streams = kernels.noisy_streams(self._values[0], rows, self.table, features)
        return self._best_of_streams(streams, action_masks)

    def move_target(self, tau: float) -> None:
        """Polyak average of the parameters."""
        online, target = self._vectors
        target.lerp_(online, tau)

    def _features(self, net: RainbowNetwork, obs: PyTorchObs) -> NDArray[np.float32]:
        if self._flattens:  # nothing for autograd to remember
            return self._extract(net, obs).detach().contiguous().numpy()
        with th.no_grad():
            return self._extract(net, obs).contiguous().numpy()

    def _extract(self, net: RainbowNetwork, obs: PyTorchObs) -> th.Tensor:
        """Features of observations; to flatten them costs less than to call a module."""
        if self._flattens:
            values = net.preprocess(obs)
            assert isinstance(values, th.Tensor)
            return values.flatten(1)
        return net.extract_features(obs, net.features_extractor)

    def _slopes(
        self,
        batch: Batch,
        weights: NDArray[np.float32],
        double_q: bool,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Slope of the weighted mean loss in the taken logits, losses and priorities."""
        net, table, n = self.q_net, self.table, batch.actions.shape[0]
        self._reserve(n)
        # Each network sees through its own extractor, unless all of them show the same.
        apart = not self._one_extractor
        if double_q or not apart:
            next_obs = next_obs_target = self._features(net, batch.next_observations)
        if apart:
            next_obs_target = self._features(self.q_net_target, batch.next_observations)
        self._obs_features = self._extract(net, batch.observations)
        obs = self._obs_features.detach().contiguous().numpy()
        for values, drawn, effective in zip(
            self._values, self._drawn, (self._effective, self._effective_target), strict=True
        ):
            kernels.effective_weights(values, drawn, table, effective)
        online = self._values[0], self._effective, table
        target = self._values[1], self._effective_target, table
        units_target = kernels.hidden_units(*target, next_obs_target, self._hidden_target)
        chooser, units_next = target, units_target
        seen = obs
        if double_q:  # one pass for both: twice the rows take less than twice the time
            seen = np.concatenate((obs, next_obs))
            obs = seen[:n]
        self._obs, self._n_seen = obs, len(seen)
        units = kernels.hidden_units(*online, seen, self._hidden)
        if double_q:
            chooser, units, units_next = online, units[:n], units[n:]
        masks = None if batch.next_action_masks is None else batch.next_action_masks.numpy()
        next_actions = self._best_actions(chooser, units_next, masks)
        self._actions = batch.actions[:, 0].numpy()
        logits = self._taken(online, units, self._actions, self._common)
        target_logits = self._taken(target, units_target, next_actions, self._common_target)
        returns = batch.rewards.numpy()
        slope, losses = np.empty_like(logits), np.empty(n, np.float32)
        discounts, dones = batch.discounts.numpy(), batch.dones.numpy()
        priorities = np.empty(n, np.float32)
        if net.head == "categorical":
            projected = np.empty_like(logits)
            learning_kernels.projected_target(
                _exponential(target_logits),
                *(returns, discounts, dones),
                *(net.v_min, net.v_max),
                projected,
            )
            log_target = th.from_numpy(projected).clamp(min=_TINY).log_().numpy()
            masses = _exponential(logits)
            learning_kernels.categorical_slopes(
                logits, masses, projected, log_target, weights, losses, priorities, slope
            )
        else:
            quantile = net.head == "quantile"
            slopes = learning_kernels.quantile_slopes if quantile else learning_kernels.huber_slopes
            slopes(
                logits, target_logits, returns, discounts, dones, weights, losses, priorities, slope
            )
        return slope, losses, priorities

    def _best_actions(
        self,
        weights: _Weights,
        units: NDArray[np.float32],
        masks: NDArray[np.bool_] | None,
    ) -> NDArray[np.int64]:
        net, n = self.q_net, units.shape[0]
        if net.head == "categorical":
            streams = self._streams[:n]
            kernels.all_streams(*weights, units, streams)
            return self._best_of_streams(streams, masks)
        means = kernels.mean_advantages(*weights, units, net.n_atoms, net.dueling)
        return self._best(means, _ONE, masks)

    def _best_of_streams(
        self,
        streams: NDArray[np.float32],
        masks: NDArray[np.bool_] | None,
    ) -> NDArray[np.int64]:
        net, n = self.q_net, streams.shape[0]
        categorical = net.head == "categorical"
        logits = self._logits[:n]
        kernels.join(streams, net.n_atoms, net.dueling, categorical, logits)
        if categorical:
            th.from_numpy(logits).exp_()
        return self._best(logits, self._support, masks)

    def _best(
        self,
        masses: NDArray[np.float32],
        support: NDArray[np.float32],
        masks: NDArray[np.bool_] | None,
    ) -> NDArray[np.int64]:
        actions = np.empty(masses.shape[0], np.int64)
        kernels.best_actions(
            *(masses, support, _NO_MASKS if masks is None else masks, actions),
            self.q_net.head == "categorical",
        )
        return actions

    def _taken(
        self,
        weights: _Weights,
        units: NDArray[np.float32],
        actions: NDArray[np.int64],
        common: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        logits = np.empty((units.shape[0], len(common)), np.float32)
        kernels.taken_logits(*weights, units, actions, self.q_net.dueling, common, logits)
        return logits


def _exponential(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Exponentials of logits, which are shifted to a maximum of 0 in place.

    Torch's are vectorized, and several times faster than those of a compiled loop.
    """
    learning_kernels.shift_to_zero(logits)
    return th.from_numpy(logits).exp().numpy()
