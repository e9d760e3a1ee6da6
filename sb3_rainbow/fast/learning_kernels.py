"""Losses, gradients and optimizer of Rainbow's multilayer perceptron; arrays as in mlp_kernels."""

import math

import numpy as np
from numpy.typing import NDArray

from sb3_rainbow.fast.mlp_kernels import (
    FAST,
    HIDDEN,
    INPUTS,
    NOISE,
    NOISY,
    OUTPUTS,
    PARAMETERS,
    Matrix,
    Table,
    Vector,
    by_action,
    rows_of,
    weights_of,
)
from sb3_rainbow.replay.compilation import njit


@njit(cache=True, fastmath=FAST, error_model="numpy")
def shift_to_zero(logits: Matrix) -> None:
    """Subtract each row's maximum, so that no exponential overflows."""
    for b in range(logits.shape[0]):
        row = logits[b]
        top = row[0]
        for j in range(row.shape[0]):
            top = max(top, row[j])
        for j in range(row.shape[0]):
            row[j] -= top


@njit(cache=True, error_model="numpy")
def projected_target(
    masses: Matrix,
    returns: Matrix,
    discounts: Matrix,
    dones: Matrix,
    v_min: float,
    v_max: float,
    target: Matrix,
) -> None:
    """As :func:`~sb3_rainbow.network.losses.project_distribution`, of masses in proportion to the
    probabilities; NaN where a return or discount is no number.
    """
    batch, n_atoms = masses.shape
    delta_z = (v_max - v_min) / (n_atoms - 1)
    target[:] = 0.0
    for b in range(batch):
        discount = discounts[b, 0] * (1.0 - dones[b, 0])
        if math.isnan(returns[b, 0]) or not math.isfinite(discount):
            # Positions that are no number would be indices outside of the array.
            target[b] = np.nan
            continue
        total = np.float32(0.0)
        for j in range(n_atoms):
            total += masses[b, j]
        for j in range(n_atoms):
            z = returns[b, 0] + discount * (v_min + j * delta_z)
            position = (min(max(z, v_min), v_max) - v_min) / delta_z
            lower = min(int(position), n_atoms - 2)
            mass = masses[b, j] / total
            upper_mass = mass * min(position - lower, 1.0)
            target[b, lower] += mass - upper_mass
            target[b, lower + 1] += upper_mass


@njit(cache=True, fastmath=FAST, error_model="numpy")
def categorical_slopes(
    logits: Matrix,
    masses: Matrix,
    target: Matrix,
    log_target: Matrix,
    weights: Vector,
    losses: Vector,
    divergences: Vector,
    slope: Matrix,
) -> None:
    """Cross-entropies, Kullback-Leibler divergences, and the slope of the cross-entropies' weighted
    mean in the logits, whose exponentials ``masses`` are. ``log_target`` is finite everywhere.
    """
    batch, n_atoms = logits.shape
    for b in range(batch):
        total = np.float32(0.0)
        for j in range(n_atoms):
            total += masses[b, j]
        log_total = np.float32(math.log(total))
        scale = np.float32(weights[b] / batch)
        share = scale / total
        loss = entropy = np.float32(0.0)
        for j in range(n_atoms):
            t = target[b, j]
            loss -= t * (logits[b, j] - log_total)
            entropy -= t * log_target[b, j]
            slope[b, j] = masses[b, j] * share - t * scale
        losses[b] = loss
        divergences[b] = max(loss - entropy, np.float32(0.0))


@njit(cache=True, error_model="numpy")
def huber_slopes(
    values: Matrix,
    target_values: Matrix,
    returns: Matrix,
    discounts: Matrix,
    dones: Matrix,
    weights: Vector,
    losses: Vector,
    errors: Vector,
    slope: Matrix,
) -> None:
    """Huber losses, absolute errors, and the slope of the losses' weighted mean in the values."""
    batch = values.shape[0]
    for b in range(batch):
        target = returns[b, 0] + discounts[b, 0] * (1.0 - dones[b, 0]) * target_values[b, 0]
        error = values[b, 0] - target
        errors[b] = abs(error)
        losses[b] = 0.5 * error * error if abs(error) < 1.0 else abs(error) - 0.5
        slope[b, 0] = min(max(error, -1.0), 1.0) * (weights[b] / batch)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def quantile_slopes(
    quantiles: Matrix,
    target_quantiles: Matrix,
    returns: Matrix,
    discounts: Matrix,
    dones: Matrix,
    weights: Vector,
    losses: Vector,
    priorities: Vector,
    slope: Matrix,
) -> None:
    """As :func:`~sb3_rainbow.network.losses.quantile_losses`, with the absolute errors of the means
    as priorities, and the slope of the losses' weighted mean in the quantiles, ``(B, N)``.
    """
    batch, n = quantiles.shape
    one, share = np.float32(1.0), np.float32(1.0 / n)
    target = np.empty(n, np.float32)
    for b in range(batch):
        discount = discounts[b, 0] * (one - dones[b, 0])
        for j in range(n):
            target[j] = returns[b, 0] + discount * target_quantiles[b, j]
        scale = share * weights[b] / np.float32(batch)
        loss = gap = np.float32(0.0)
        for j in range(n):
            gap += target[j] - quantiles[b, j]
        for i in range(n):
            above = (np.float32(i) + np.float32(0.5)) * share
            value, part, rise = quantiles[b, i], np.float32(0.0), np.float32(0.0)
            for j in range(n):
                error = target[j] - value
                tilt = above if error >= np.float32(0.0) else one - above
                cut = min(max(error, -one), one)
                part += tilt * cut * (error - np.float32(0.5) * cut)
                rise += tilt * cut
            loss += part
            slope[b, i] = -rise * scale
        losses[b] = loss * share
        priorities[b] = abs(gap) * share


@njit(cache=True)
def _mean_gradients(gradient: Vector, table: Table, layer: int) -> tuple[Matrix, Vector]:
    """Views of the gradients of a layer's weight and bias; where it is noisy, of their means."""
    n_in, n_out, p = table[layer, INPUTS], table[layer, OUTPUTS], table[layer, PARAMETERS]
    size = n_in * n_out
    bias = p + size * (1 + table[layer, NOISY])
    return gradient[p : p + size].reshape((n_out, n_in)), gradient[bias : bias + n_out]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def backward(
    parameters: Vector,
    effective: Vector,
    table: Table,
    inputs: Matrix,
    hidden: Vector,
    n_seen: int,
    actions: NDArray[np.int64],
    dueling: bool,
    common: Matrix,
    slope: Matrix,
    gradient: Vector,
    input_gradient: Matrix,
) -> None:
    """Gradients of parameters, but for the sigmas, and of inputs, if these are not ``(0, 0)``.

    ``slope`` is that of the taken logits ``(B, n_atoms)``. ``hidden`` is as ``hidden_units`` left
    it, which was given ``n_seen`` rows, the batch's first.
    """
    batch, n_atoms = slope.shape
    n_layers = table.shape[0]
    weight, _ = weights_of(parameters, effective, table, n_layers - 1)
    n_out, n_in = weight.shape
    weight_gradient, bias = _mean_gradients(gradient, table, n_layers - 1)
    units = inputs
    if n_layers > 1:
        start = table[n_layers - 2, HIDDEN] * n_seen
        units = hidden[start : start + batch * n_in].reshape((batch, n_in))
    size = n_atoms * n_in
    flat = weight_gradient.reshape(n_out * n_in)
    if dueling:
        np.dot(slope.T, units, weight_gradient[:n_atoms])
        bias[:n_atoms] = 0.0
        for b in range(batch):
            for j in range(n_atoms):
                bias[j] += slope[b, j]
    delta = np.empty((batch, n_in), np.float32)
    np.dot(slope, common, delta)
    first_stream = 1 if dueling else 0
    n_actions = n_out // n_atoms - first_stream
    order, ends = by_action(actions, n_actions)
    sorted_units, sorted_slope = rows_of(units, order), rows_of(slope, order)
    own = np.empty(delta.shape, np.float32)
    share = np.float32(-1.0 / n_actions)
    start = 0
    for a in range(n_actions):
        first, end = (a + first_stream) * n_atoms, ends[a]
        part, part_bias = flat[first * n_in : first * n_in + size], bias[first : first + n_atoms]
        part_bias[:] = 0.0
        if end > start:
            rows, slopes = sorted_units[start:end], sorted_slope[start:end]
            np.dot(slopes.T, rows, weight_gradient[first : first + n_atoms])
            np.dot(slopes, weight[first : first + n_atoms], own[start:end])
        else:
            part[:] = 0.0
        for k in range(start, end):
            back, given = delta[order[k]], own[k]
            for i in range(n_in):
                back[i] += given[i]
            for j in range(n_atoms):
                part_bias[j] += sorted_slope[k, j]
        if dueling:
            for k in range(size):
                part[k] += share * flat[k]
            for j in range(n_atoms):
                part_bias[j] += share * bias[j]
        start = end
    for layer in range(n_layers - 2, -1, -1):
        n_in, n_out = table[layer, INPUTS], table[layer, OUTPUTS]
        h = table[layer, HIDDEN] * n_seen
        outputs = hidden[h : h + batch * n_out].reshape((batch, n_out))
        weight_gradient, layer_bias = _mean_gradients(gradient, table, layer)
        layer_bias[:] = 0.0
        for b in range(batch):
            for j in range(n_out):
                passed = np.float32(0.0) if outputs[b, j] <= 0.0 else delta[b, j]
                delta[b, j] = passed
                layer_bias[j] += passed
        below = inputs
        if layer > 0:
            start = table[layer - 1, HIDDEN] * n_seen
            below = hidden[start : start + batch * n_in].reshape((batch, n_in))
        np.dot(delta.T, below, weight_gradient)
        if layer > 0 or input_gradient.shape[0] > 0:
            above, delta = delta, np.empty((batch, n_in), np.float32)
            np.dot(above, weights_of(parameters, effective, table, layer)[0], delta)
    for b in range(input_gradient.shape[0]):
        for i in range(input_gradient.shape[1]):  # an assignment of arrays takes 2 s to compile
            input_gradient[b, i] = delta[b, i]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def sigma_gradients(gradient: Vector, noise: Vector, table: Table) -> None:
    """Gradients of the noisy layers' sigmas from those of their means, in one vector."""
    for layer in range(table.shape[0]):
        if table[layer, NOISY] == 0:
            continue
        n_in, n_out = table[layer, INPUTS], table[layer, OUTPUTS]
        first, sigma = table[layer, NOISE], table[layer, PARAMETERS] + n_in * n_out
        epsilon_in = noise[first : first + n_in]
        mean, bias = _mean_gradients(gradient, table, layer)
        for j in range(n_out):
            epsilon_out = noise[first + n_in + j]
            row = mean[j]
            out = gradient[sigma + j * n_in : sigma + (j + 1) * n_in]
            for i in range(n_in):
                out[i] = row[i] * (epsilon_out * epsilon_in[i])
            gradient[sigma + n_in * n_out + n_out + j] = bias[j] * epsilon_out


@njit(cache=True, fastmath=FAST, error_model="numpy")
def clip(gradient: Vector, max_norm: float) -> None:
    """Scale the gradient down to a norm of ``max_norm``, in place."""
    square = np.float32(0.0)
    for i in range(gradient.shape[0]):
        square += gradient[i] * gradient[i]
    scale = np.float32(min(1.0, max_norm / (math.sqrt(square) + 1e-6)))
    if scale != np.float32(1.0):
        for i in range(gradient.shape[0]):
            gradient[i] *= scale


@njit(cache=True, fastmath=FAST, error_model="numpy")
def adam_step(
    parameters: Vector,
    gradient: Vector,
    first: Vector,
    second: Vector,
    lr: float,
    beta1: float,
    beta2: float,
    epsilon: float,
    weight_decay: float,
    step: float,
) -> None:
    """One step of Adam with L2 decay."""
    b1, b2, decay = np.float32(beta1), np.float32(beta2), np.float32(weight_decay)
    one = np.float32(1.0)
    size = np.float32(lr / (1.0 - beta1**step))
    correction = np.float32(1.0 / math.sqrt(1.0 - beta2**step))
    small = np.float32(epsilon)
    for i in range(gradient.shape[0]):
        g = gradient[i] + decay * parameters[i]
        first[i] += (one - b1) * (g - first[i])
        second[i] = b2 * second[i] + (one - b2) * g * g
        parameters[i] -= size * first[i] / (np.float32(math.sqrt(second[i])) * correction + small)
