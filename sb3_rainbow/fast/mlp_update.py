"""Updates of plain networks on the CPU by compiled kernels instead of torch's autograd."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from operator import is_

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from threadpoolctl import LibController, ThreadpoolController
from torch import nn

from sb3_rainbow.fast import learning_kernels
from sb3_rainbow.fast import mlp_kernels as kernels
from sb3_rainbow.fast.adam import GRAD, AdamOnVector, parts, share
from sb3_rainbow.network.noisy_linear import NoisyLinear
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.type_aliases import Batch

# Below any probability that float32 holds as a normal number
_TINY = float(np.finfo(np.float32).tiny)
_NO_MASKS = np.zeros((0, 0), dtype=np.bool_)
_ONE = np.ones(1, dtype=np.float32)
_NO_GRADIENT = np.zeros((0, 0), dtype=np.float32)
# An extractor of these parts alone has the same features for the target network, and however often
# it is called: nothing in it changes, learns or draws random numbers.
_STATELESS = (FlattenExtractor, CombinedExtractor, nn.ModuleDict, nn.Flatten)
_PARAMETERS = {
    NoisyLinear: ("weight_mu", "weight_sigma", "bias_mu", "bias_sigma"),
    nn.Linear: ("weight", "bias"),
}
_Weights = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]


@lru_cache(maxsize=1)
def blas_libraries() -> list[LibController]:
    """Every BLAS of this process, the one whose products numba uses included."""
    import scipy.linalg.cython_blas  # noqa: F401  which loads it

    return ThreadpoolController().select(user_api="blas").lib_controllers


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Keep BLAS, which numba's matrix products use, to one thread.

    The products of a small network are over before a second thread has started. threadpoolctl's own
    ``limit`` asks each library for all that it knows, which takes ten times as long.
    """
    changed = [(each, n) for each in blas_libraries() if (n := each.get_num_threads()) != 1]
    for library, _ in changed:
        library.set_num_threads(1)
    try:
        yield
    finally:
        for library, n in changed:
            library.set_num_threads(n)


def parameters_of(net: RainbowNetwork) -> list[nn.Parameter]:
    """The layers' parameters in the order in which the kernels want them, then the extractor's."""
    own = [getattr(layer, name) for layer in net.layers for name in _PARAMETERS[type(layer)]]
    return [*own, *net.features_extractor.parameters()]


def table_of(net: RainbowNetwork) -> NDArray[np.int64]:
    """Sizes and offsets of each layer, ``(n_layers, 8)``."""
    rows = []
    parameters = noise = effective = hidden = 0
    for layer in net.layers:
        assert isinstance(layer, NoisyLinear | nn.Linear)
        noisy = isinstance(layer, NoisyLinear)
        n_in, n_out = layer.in_features, layer.out_features
        shared = layer.outputs_per_noise if noisy else 1
        rows.append([n_in, n_out, int(noisy), parameters, noise, effective, hidden, shared])
        size = (n_in + 1) * n_out
        parameters += 2 * size if noisy else size
        noise += n_in + n_out if noisy else 0
        effective += size if noisy else 0
        hidden += n_out
    return np.asarray(rows, dtype=np.int64)


class _FlatNetwork:
    """A network whose parameters and noise are parts of vectors, which the kernels see as arrays.

    To ask torch for the memory of a tensor takes as long as to call a kernel: it is kept.
    """

    def __init__(self, net: RainbowNetwork) -> None:
        self.net, self.table, self.parameters = net, table_of(net), parameters_of(net)
        layers = net.layers_drawn_together()
        epsilons = [e for layer in layers for e in (layer.epsilon_in, layer.epsilon_out)]
        self.vector, self.noise = share(self.parameters), share(epsilons)
        self.values, self.drawn = self.vector.numpy(), self.noise.numpy()
        self._shared = [*self.parameters, *epsilons]
        self._addresses = self._present_addresses()
        n_in, n_out, noisy = self.table[-1, [kernels.INPUTS, kernels.OUTPUTS, kernels.NOISY]]
        n_effective = int(self.table[-1, kernels.EFFECTIVE] + noisy * (n_in + 1) * n_out)
        self.effective = np.zeros(n_effective, np.float32)
        self.common = np.zeros((net.n_atoms, n_in), np.float32)

    def _present_addresses(self) -> list[int]:
        return list(map(th.Tensor.data_ptr, self._shared))

    def is_current(self) -> bool:
        """Whether parameters and noise have the memory they had."""
        return self._present_addresses() == self._addresses

    @property
    def weights(self) -> _Weights:
        """Parameters, effective weights of the noisy layers, and the table of both."""
        return self.values, self.effective, self.table

    def draw_noise(self) -> None:
        """Draw new noise for all noisy layers."""
        self.noise.normal_()
        kernels.scale_noise(self.drawn[None], self.table)

    def renew_weights(self) -> None:
        """Compute the effective weights under the present noise."""
        kernels.effective_weights(self.values, self.drawn, self.table, self.effective)

    def taken_logits(
        self, units: NDArray[np.float32], actions: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Logits of one action per sample, ``(B, n_atoms)``, of the last hidden units."""
        logits = np.empty((units.shape[0], len(self.common)), np.float32)
        kernels.taken_logits(*self.weights, units, actions, self.net.dueling, self.common, logits)
        return logits


class MlpUpdate:
    """What :class:`~sb3_rainbow.learner.learner.Learner` does, for ReLU perceptrons on the CPU.

    An update of a small network is mostly overhead: some hundred tensor operations, each with its
    allocation and its autograd node. Here it is a few compiled calls on the memory of torch's own
    tensors, which stay the one place where parameters, noise and Adam's moments live. The head is
    evaluated for the action that counts, where torch would compute all. What an extractor learns,
    such as convolutions, torch differentiates.

    While it is ``settled``, an update does not look whether anyone has touched the optimizer.
    """

    def __init__(self, q_net: RainbowNetwork, q_net_target: RainbowNetwork) -> None:
        self.q_net, self.q_net_target = q_net, q_net_target
        self._online, self._target = _FlatNetwork(q_net), _FlatNetwork(q_net_target)
        self._parameters, self.table = self._online.parameters, self._online.table
        gradient = th.zeros_like(self._online.vector)
        self._gradient = gradient.numpy()
        self._gradients = parts(gradient, self._parameters)
        self._adam = AdamOnVector(self._parameters, self._online.vector, gradient, self._gradients)
        extractors = q_net.features_extractor, q_net_target.features_extractor
        self._n_own = len(self._parameters) - len(list(extractors[0].parameters()))
        self._one_extractor = all(type(m) in _STATELESS for m in extractors[0].modules())
        self._flattens = all(
            type(extractor) is FlattenExtractor and type(extractor.flatten) is nn.Flatten
            for extractor in extractors
        )
        self._support = q_net.support.numpy()
        self.settled = False
        self._capacity = 0

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
        """Whether both networks have the memory they had, and Adam is still Adam."""
        current = self._online.is_current() and self._target.is_current()
        return current and self._adam.is_possible(optimizer, self._adam.ids)

    @contextmanager
    def undisturbed(self, optimizer: th.optim.Optimizer) -> Iterator[None]:
        """Check once, before updates that nobody disturbs, what each would check by itself.

        That is possible only if both extractors just flatten; otherwise each update checks.
        """
        self.settled = self._flattens and self._adam.is_ready(optimizer)
        if self.settled:
            self._put_gradients()
        try:
            yield
        finally:
            self.settled = False

    def _put_gradients(self) -> None:
        if not all(map(is_, map(GRAD, self._parameters), self._gradients)):
            for p, gradient in zip(self._parameters, self._gradients, strict=True):
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
        self._online.draw_noise()
        self._target.draw_noise()
        weights = batch.weights.numpy()
        slope, losses, priorities = self._slopes(batch, weights, double_q)
        learns = self._obs_features.requires_grad
        input_gradient = np.empty_like(self._obs) if learns else _NO_GRADIENT
        learning_kernels.backward(
            *self._online.weights,
            self._obs,
            self._hidden,
            self._n_seen,
            self._actions,
            self.q_net.dueling,
            self._online.common,
            slope,
            self._gradient,
            input_gradient,
        )
        learning_kernels.sigma_gradients(self._gradient, self._online.drawn, self.table)
        if self.settled:
            self._adam.step_when_ready(optimizer, max_grad_norm)
        else:
            self._put_gradients()
            self._learn_extractor(input_gradient if learns else None)
            self._adam.step(optimizer, max_grad_norm)
        del self._obs_features
        mean = np.asarray(float(losses @ weights) / len(losses), np.float32)
        return th.from_numpy(mean), th.from_numpy(priorities)

    def _learn_extractor(self, input_gradient: NDArray[np.float32] | None) -> None:
        learnt = self._parameters[self._n_own :]
        for p in learnt:
            p.grad = None
        if input_gradient is not None:
            self._obs_features.backward(th.from_numpy(input_gradient))
        for p, gradient in zip(learnt, self._gradients[self._n_own :], strict=True):
            if p.grad is None:  # not all of an extractor need have learned
                gradient.zero_()
            else:
                p.grad = gradient.copy_(p.grad)

    @single_blas_thread()
    def act(self, obs: th.Tensor, action_masks: NDArray[np.bool_] | None) -> NDArray[np.int64]:
        """As ``Learner.act``: each environment has noise of its own."""
        features = self._features(self.q_net, obs)
        n, online = features.shape[0], self._online
        self._reserve(n)
        if n > 1:
            rows = online.noise.new_empty(n, len(online.noise)).normal_().numpy()
            kernels.scale_noise(rows, self.table)
        else:
            online.draw_noise()
            rows = online.drawn[None]
        streams = kernels.noisy_streams(online.values, rows, self.table, features)
        return self._best_of_streams(streams, action_masks)

    def move_target(self, tau: float) -> None:
        """Polyak average of the parameters."""
        self._target.vector.lerp_(self._online.vector, tau)

    def _features(self, net: RainbowNetwork, obs: PyTorchObs) -> NDArray[np.float32]:
        if self._flattens:  # nothing for autograd to remember
            return self._extract(net, obs).detach().contiguous().numpy()
        with th.no_grad():
            return self._extract(net, obs).contiguous().numpy()

    def _extract(self, net: RainbowNetwork, obs: PyTorchObs) -> th.Tensor:
        """Features of observations; to flatten them costs less than to call a module."""
        if self._flattens:
            space, images = net.observation_space, net.normalize_images
            values = preprocess_obs(obs, space, normalize_images=images)
            assert isinstance(values, th.Tensor)
            return values.flatten(1)
        return net.extract_features(obs, net.features_extractor)

    def _slopes(
        self, batch: Batch, weights: NDArray[np.float32], double_q: bool
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Slope of the weighted mean loss in the taken logits, losses and priorities."""
        net, online, target, n = self.q_net, self._online, self._target, batch.actions.shape[0]
        self._reserve(n)
        # Each network sees through its own extractor, unless all of them show the same.
        apart = not self._one_extractor
        if double_q or not apart:
            next_obs = next_obs_target = self._features(net, batch.next_observations)
        if apart:
            next_obs_target = self._features(self.q_net_target, batch.next_observations)
        self._obs_features = self._extract(net, batch.observations)
        obs = self._obs_features.detach().contiguous().numpy()
        online.renew_weights()
        target.renew_weights()
        units_target = kernels.hidden_units(*target.weights, next_obs_target, self._hidden_target)
        chooser, units_next = target, units_target
        seen = obs
        if double_q:  # one pass for both: twice the rows take less than twice the time
            seen = np.concatenate((obs, next_obs))
            obs = seen[:n]
        self._obs, self._n_seen = obs, len(seen)
        units = kernels.hidden_units(*online.weights, seen, self._hidden)
        if double_q:
            chooser, units, units_next = online, units[:n], units[n:]
        masks = None if batch.next_action_masks is None else batch.next_action_masks.numpy()
        next_actions = self._best_actions(chooser.weights, units_next, masks)
        self._actions = batch.actions[:, 0].numpy()
        logits = online.taken_logits(units, self._actions)
        target_logits = target.taken_logits(units_target, next_actions)
        target_of = batch.rewards.numpy(), batch.discounts.numpy(), batch.dones.numpy()
        slope = np.empty_like(logits)
        losses, priorities = np.empty(n, np.float32), np.empty(n, np.float32)
        if net.head == "categorical":
            projected = np.empty_like(logits)
            next_masses = _exponential(target_logits)
            learning_kernels.projected_target(
                next_masses, *target_of, net.v_min, net.v_max, projected
            )
            log_target = th.from_numpy(projected).clamp(min=_TINY).log_().numpy()
            masses = _exponential(logits)
            learning_kernels.categorical_slopes(
                logits, masses, projected, log_target, weights, losses, priorities, slope
            )
        else:
            quantile = net.head == "quantile"
            slopes = learning_kernels.quantile_slopes if quantile else learning_kernels.huber_slopes
            slopes(logits, target_logits, *target_of, weights, losses, priorities, slope)
        return slope, losses, priorities

    def _best_actions(
        self, weights: _Weights, units: NDArray[np.float32], masks: NDArray[np.bool_] | None
    ) -> NDArray[np.int64]:
        net = self.q_net
        if net.head == "categorical":
            streams = self._streams[: units.shape[0]]
            kernels.all_streams(*weights, units, streams)
            return self._best_of_streams(streams, masks)
        means = kernels.mean_advantages(*weights, units, net.n_atoms, net.dueling)
        return self._best(means, _ONE, masks)

    def _best_of_streams(
        self, streams: NDArray[np.float32], masks: NDArray[np.bool_] | None
    ) -> NDArray[np.int64]:
        net, categorical = self.q_net, self.q_net.head == "categorical"
        logits = self._logits[: streams.shape[0]]
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
        allowed = _NO_MASKS if masks is None else masks
        kernels.best_actions(masses, support, allowed, actions, self.q_net.head == "categorical")
        return actions


def _exponential(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Exponentials of logits, which are shifted to a maximum of 0 in place.

    Torch's are vectorized, and several times faster than those of a compiled loop.
    """
    learning_kernels.shift_to_zero(logits)
    return th.from_numpy(logits).exp().numpy()
