"""What a stored policy does, in numpy alone: the networks of Stable-Baselines3's PPO and SAC, without torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.controller import Actions, Observations
from agents.store import Card, Normalisation
from magenv.params import InputError, require

Floats = NDArray[np.float64]
Shapes = dict[str, tuple[int, ...]]

_HIDDEN = {"ppo": "mlp_extractor.policy_net", "sac": "actor.latent_pi"}
_LAST = {"ppo": "action_net", "sac": "actor.mu"}
ALGORITHMS = tuple(_HIDDEN)


def normalise(observation: Observations, statistics: Normalisation, clip: float) -> Observations:
    """Return observations less their mean over their standard deviation, cut at ``clip``, as ``VecNormalize`` does."""
    scaled = (observation - statistics.mean) / np.sqrt(statistics.variance + 1e-8)
    return np.clip(scaled, -clip, clip).astype(np.float32)


def _linear(name: str, inputs: int, outputs: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def _layers(name: str, *widths: int) -> Shapes:
    """Return the shapes of layers between these widths; functions stand between them, and count."""
    shapes: Shapes = {}
    for i in range(len(widths) - 1):
        shapes |= _linear(f"{name}.{2 * i}", widths[i], widths[i + 1])
    return shapes


def shapes_of(algo: str, net: tuple[int, ...], inputs: int, outputs: int) -> Shapes:
    """Return the shapes of all weights of a policy by name, those of its value functions among them."""
    shapes = _layers(_HIDDEN[algo], inputs, *net) | _linear(_LAST[algo], net[-1], outputs)
    if algo == "ppo":
        shapes |= _layers("mlp_extractor.value_net", inputs, *net) | _linear("value_net", net[-1], 1)
        return shapes | {"log_std": (outputs,)}
    for critic in ("critic", "critic_target"):
        for number in range(2):
            shapes |= _layers(f"{critic}.qf{number}", inputs + outputs, *net, 1)
    return shapes | _linear("actor.log_std", net[-1], outputs)


class Player:
    """The mode of a stored policy: its mean action within the bounds [-1, 1] that all actions have.

    PPO's mean is clipped, SAC's goes through a hyperbolic tangent. All in double precision: rounding does not depend on
    how many observations come together.

    Parameters
    ----------
    card : Card
        Of the model.
    weights : mapping
        All of the policy's (see ``agents.store.load_policy``).
    statistics : Normalisation
        Of what it sees.
    inputs, outputs : int
        How many numbers it sees, and how many it gives, in the card's environment.

    Raises
    ------
    ValueError
        If the algorithm is unknown, or weights or statistics do not fit card and environment, or may give numbers that
        are not finite.
    """

    def __init__(
        self, card: Card, weights: Mapping[str, NDArray[Any]], statistics: Normalisation, inputs: int, outputs: int
    ) -> None:
        require(card.algo in ALGORITHMS, "model", "of algorithm " + " or ".join(ALGORITHMS), card.algo)
        _check(card, weights, inputs, outputs)
        size = (inputs,)
        for told in (statistics.mean, statistics.variance):
            require(told.shape == size, "model", f"statistics of shape {size}", told.shape)
        self._squashed, self._rectified = card.algo == "sac", card.activation == "relu"
        self._statistics, self._clip = statistics, card.clip_observation
        names = [f"{_HIDDEN[card.algo]}.{2 * i}" for i in range(len(card.net))] + [_LAST[card.algo]]
        both = [(weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names]
        self._layers = [(weight.T.astype(np.float64), bias.astype(np.float64)) for weight, bias in both]
        self._check_finite()

    def _check_finite(self) -> None:
        """Raise ``ValueError`` unless no observation can bring any layer beyond single precision, as in training."""
        bound: Floats = np.full(len(self._layers[0][0]), self._clip)
        for weight, bias in self._layers:
            bound = bound @ np.abs(weight) + np.abs(bias)
            finite = bool((bound <= np.finfo(np.float32).max).all())
            require(finite, "model", "weights that give finite actions", f"{float(bound.max()):.2g} at most")
            bound = bound if self._rectified else np.minimum(bound, 1.0)

    def __call__(self, observation: Observations) -> Actions:
        """Return actions (..., a) within [-1, 1] for observations (..., d) as the environment tells them."""
        told: Floats = normalise(observation, self._statistics, self._clip).astype(np.float64)
        *hidden, (weight, bias) = self._layers
        for weights, biases in hidden:
            told = told @ weights + biases
            told = np.maximum(told, 0.0) if self._rectified else np.tanh(told)
        mean = told @ weight + bias
        return (np.tanh(mean) if self._squashed else np.clip(mean, -1.0, 1.0)).astype(np.float32)


def _check(card: Card, weights: Mapping[str, NDArray[Any]], inputs: int, outputs: int) -> None:
    """Raise ``ValueError`` unless the weights are those of the card's networks in its environment."""
    shapes = shapes_of(card.algo, card.net, inputs, outputs)
    for name in shapes:
        require(name in weights, "model", f"weights with {name}, as its card tells", "a file without")
    for name in weights:
        require(name in shapes, "model", "weights that fit its card", f"a file with {name[:80]}")
    first, last = (weights[f"{name}.weight"].shape for name in (f"{_HIDDEN[card.algo]}.0", _LAST[card.algo]))
    if first[-1:] != (inputs,) or last[:1] != (outputs,):
        s, sizes = card.settings, [*first[-1:], *last[:1]]
        environment = f"observation {s.observation!r}, action {s.action!r}, n_epm {s.n_epm}"
        if card.residual is not None:
            environment += f", and it corrects {card.residual.controller}"
        if card.history > 1:
            environment += f", and it sees {card.history} observations"
        raise InputError(
            f"Input model must be weights for sizes [{inputs}, {outputs}] of observation and action, as its card tells "
            f"({environment}); instead received weights for {sizes}."
        )
    for name, shape in shapes.items():
        fits = weights[name].shape == shape
        require(fits, f"model's {name}", f"of shape {shape}, as its card tells", weights[name].shape)
