"""Layers with learned exploration noise."""

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch as th
from torch import nn
from torch.nn import functional as F

# Up to so many, a second matrix product costs less than forming the noisy weights
_FEW_INPUTS = 16


def scale_noise_(noise: th.Tensor) -> th.Tensor:
    """Replace x by sign(x) sqrt(|x|) (Fortunato et al. 2018, section 3), in place."""
    return th.copysign(noise.abs().sqrt_(), noise, out=noise)


def share_noise_(noise: th.Tensor, n_outputs: int) -> th.Tensor:
    """Give each ``n_outputs`` outputs in a row the noise of the first of them, in place."""
    if n_outputs > 1:
        groups = noise.unflatten(-1, (-1, n_outputs))
        groups.copy_(groups[..., :1].clone())
    return noise


class NoisyLinear(nn.Module):
    """Linear layer with factorized Gaussian noise on weights and biases (Fortunato et al. 2018).

    ``y = (mu_w + sigma_w * (e_out e_in^T)) x + mu_b + sigma_b * e_out``, with ``e = f(N(0, 1))``
    and ``f(x) = sign(x) sqrt(|x|)``: ``in + out`` random numbers instead of ``in * out``.

    The caller says at each call whether the noise acts; ``train()`` and ``eval()`` do not matter,
    because SB3 collects experience in evaluation mode. The noise stays until :meth:`reset_noise`.
    It lies in buffers, which a Polyak average over the parameters leaves alone.

    Args:
        sigma0: initial noise scale; every sigma starts at ``sigma0 / sqrt(in_features)``.
        outputs_per_noise: outputs in a row that share their output noise. The quantiles of an
            action do: with noise of their own, their mean, which chooses the action, would hardly
            move.
    """

    epsilon_in: th.Tensor
    epsilon_out: th.Tensor
    #: noise of each row of a batch of as many rows, ``(n, in)`` and ``(n, out)``, instead of one
    epsilon_rows: tuple[th.Tensor, th.Tensor] | None = None
    _silent: bool = False

    def __init__(
        self, in_features: int, out_features: int, sigma0: float = 0.5, outputs_per_noise: int = 1
    ) -> None:
        super().__init__()
        self.in_features = in_features
        self.out_features = out_features
        self.sigma0 = sigma0
        self.outputs_per_noise = outputs_per_noise
        self.weight_mu = nn.Parameter(th.empty(out_features, in_features))
        self.weight_sigma = nn.Parameter(th.empty(out_features, in_features))
        self.bias_mu = nn.Parameter(th.empty(out_features))
        self.bias_sigma = nn.Parameter(th.empty(out_features))
        self.register_buffer("epsilon_in", th.zeros(in_features))
        self.register_buffer("epsilon_out", th.zeros(out_features))
        self.reset_parameters()
        self.reset_noise()

    def reset_parameters(self) -> None:
        """Initial means and sigmas of the factorized variant (same paper, section 3.2)."""
        bound = 1.0 / math.sqrt(self.in_features)
        nn.init.uniform_(self.weight_mu, -bound, bound)
        nn.init.uniform_(self.bias_mu, -bound, bound)
        nn.init.constant_(self.weight_sigma, self.sigma0 * bound)
        nn.init.constant_(self.bias_sigma, self.sigma0 * bound)

    @th.no_grad()
    def reset_noise(self) -> None:
        """Draw new noise from torch's global generator, the same for all rows of a batch."""
        self.epsilon_rows = None
        scale_noise_(self.epsilon_in.normal_())
        share_noise_(scale_noise_(self.epsilon_out.normal_()), self.outputs_per_noise)

    def set_noise(self, epsilon_in: th.Tensor, epsilon_out: th.Tensor) -> None:
        """Take scaled noise, ``(in,)`` and ``(out,)``, or a row for each row of a batch."""
        share_noise_(epsilon_out, self.outputs_per_noise)
        if epsilon_in.ndim == 1:
            self.epsilon_rows = None
            if self.epsilon_in.is_inference():  # copied there: nobody could write into it
                with th.inference_mode(False):
                    self.epsilon_in = th.empty_like(self.epsilon_in)
                    self.epsilon_out = th.empty_like(self.epsilon_out)
            self.epsilon_in.copy_(epsilon_in)
            self.epsilon_out.copy_(epsilon_out)
        else:
            self.epsilon_rows = epsilon_in, epsilon_out

    def forward(self, inputs: th.Tensor, noisy: bool = True) -> th.Tensor:
        """Outputs ``(..., out_features)`` of ``(..., in_features)``, with noise or without."""
        if not noisy or self._silent:
            return F.linear(inputs, self.weight_mu, self.bias_mu)
        rows = self.epsilon_rows
        if rows is not None and inputs.shape == rows[0].shape:
            return self._without_a_matrix(inputs, *rows)
        if inputs[..., 0].numel() <= _FEW_INPUTS:
            return self._without_a_matrix(inputs, self.epsilon_in, self.epsilon_out)
        epsilon = th.outer(self.epsilon_out, self.epsilon_in)
        weight = th.addcmul(self.weight_mu, self.weight_sigma, epsilon)
        return F.linear(inputs, weight, th.addcmul(self.bias_mu, self.bias_sigma, self.epsilon_out))

    def _without_a_matrix(
        self, inputs: th.Tensor, epsilon_in: th.Tensor, epsilon_out: th.Tensor
    ) -> th.Tensor:
        # (sigma * e_out e_in^T) x = e_out * sigma (e_in * x): no noise matrix is formed.
        outputs = F.linear(inputs, self.weight_mu, self.bias_mu)
        noise = F.linear(inputs * epsilon_in, self.weight_sigma, self.bias_sigma)
        return th.addcmul(outputs, noise, epsilon_out)

    def extra_repr(self) -> str:
        """What ``print`` shows of the layer."""
        return f"{self.in_features}, {self.out_features}, sigma0={self.sigma0}"


@contextmanager
def silenced(layers: Iterable[NoisyLinear]) -> Iterator[None]:
    """Let layers that others call use their mean weights in here."""
    silent = list(layers)
    for layer in silent:
        layer._silent = True
    try:
        yield
    finally:
        for layer in silent:
            layer._silent = False
