"""What an encoder φ is. `*` is any batch prefix, M states, F frames of the data, N frames of a state, D latent dimension."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, cast

from torch import Tensor, nn

from velap.config import ModelConfig
from velap.registry import ENCODERS


class Target(NamedTuple):
    """What φ is to tell of every frame in the encoder phase; a small network predicts it from the latent."""

    name: str
    """How losses call it."""
    parts: tuple[Tensor, ...]
    """Values [F, C] side by side, standardised."""
    weights: tuple[float, ...]
    """Weight of each part's mean-squared error."""
    hidden: tuple[int, ...]
    """Hidden layers of the network that predicts them."""


class Encoder(nn.Module):
    """φ: stacks of frames to latents. An encoder is a subclass with `__init__(config, size)` and `encode`.

        @register_encoder("mine")
        class Mine(Encoder):
            def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None: ...   # size: height, width [px]
            def encode(self, stacks: Tensor) -> Tensor: ...                               # uint8 [M, N, H, W, 3] -> [M, D]

    One that measures something of each frame first says what in `features`; `encode` then gets stacks of that.
    """

    chunk = 1024
    """States that the data are encoded by at once."""

    @classmethod
    def width(cls, config: ModelConfig) -> int:
        """D, dimensions of its output."""
        return config.latent_dim

    def fit(self, frames: Tensor, last: Tensor, seed: int) -> Tensor:
        """Learn what it needs from all frames of the data before any phase; returns their features [F, ...].

        frames: uint8 [F, H, W, 3]; last: int64 [F], last row of each frame's episode.
        """
        return self.measure(frames)

    def measure(self, frames: Tensor) -> Tensor:
        """`features` of all frames of the data, in pieces where they are not the frames themselves."""
        return self.features(frames)

    def features(self, frames: Tensor) -> Tensor:
        """What is measured of frames once: uint8 [F, H, W, 3] → [F, ...]; the frames themselves unless said otherwise."""
        return frames

    def encode(self, stacks: Tensor) -> Tensor:
        """Features of the frames of states [M, N, ...], oldest first → latents [M, D]."""
        raise NotImplementedError

    @classmethod
    def learnt_width(cls, config: ModelConfig) -> int:
        """Dimensions of `learnt`."""
        return cls.width(config)

    def learnt(self, stacks: Tensor) -> Tensor:
        """The part of the latents that the encoder phase trains: [M, N, ...] → [M, `learnt_width`]."""
        return self.encode(stacks)

    def targets(self, features: Tensor, first: Tensor, last: Tensor) -> tuple[Target, ...]:
        """What the encoder phase teaches besides the actions between states; none stands for the pixels of the newest frame.

        features [F, ...] of all frames; first, last int64 [F], the episode's ends.
        """
        return ()

    def forward(self, frames: Tensor) -> Tensor:
        """uint8 `[*, N, H, W, 3] → [*, D]`."""
        prefix, shape = frames.shape[:-4], frames.shape[-4:]
        features = self.features(frames.reshape(-1, *shape[1:]))
        return self.encode(features.view(-1, shape[0], *features.shape[1:])).reshape(*prefix, -1)


def in_parts(function: Callable[[Tensor], Tensor], whole: Tensor, size: int) -> Tensor:
    """`function` of `size` rows at a time: [M, ...] → [M, ...].

    The results go into one tensor at once. A list of them lies scattered among the memory that the function freed, and keeps
    the process from returning it: 6 kB a frame in a training.
    """
    first = function(whole[:size])
    result = first.new_empty(len(whole), *first.shape[1:])
    result[: len(first)] = first
    for start in range(size, len(whole), size):
        result[start : start + size] = function(whole[start : start + size])
    return result


def encoder_class(config: ModelConfig) -> type[Encoder]:
    """The registered encoder that a config names; raises UnknownTaskError with the names that exist."""
    return cast(type[Encoder], ENCODERS[config.encoder])


def latent_width(config: ModelConfig, actions: int, state: int = 0) -> int:
    """D with all that is in a latent: φ's output, the remembered commands of `actions` action dimensions, and `state`
    entries of the state."""
    return encoder_class(config).width(config) + min(config.command_dims, actions) + state
