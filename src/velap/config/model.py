"""Config of the model (Eq. 1, App. B.1). Layer sizes are constants of `velap.models.networks`: Tables 2-6."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from velap.config.fields import require

Norm = Literal["batch", "layer"]


@dataclass(frozen=True)
class ModelConfig:
    """Networks of Eq. 1. A width of 32 latent dimensions is Table 7's."""

    encoder: str = "conv"
    """φ by its registered name: `conv` (Table 2), `slow-moments` or `moments` (ours: colour moments tell places to a tenth
    of a pixel after a minute of training), or one of another package."""
    frame_stack: int = 3
    """N, frames in a state [frames]. ours: the paper leaves N open for the simulated tasks and uses 3 on hardware (E.1)."""
    latent_dim: int = 32
    """d_Z, Table 7: units that φ learns. Encoders of moments add the moments that they keep."""
    norm: Norm = "layer"
    """Normalisation of hidden layers. Tables 2-6: batch. ours: layer, which needs no batch statistics in targets."""
    dynamics_residual: bool = True
    """h predicts z + f(z, a) instead of f(z, a). ours: Table 3 is silent; off in `paper`."""
    critic_bounded: bool = True
    """Critics end in a sigmoid: returns of a terminal 0/1 reward lie in [0, 1]. ours; off in `paper`."""
    n_global: int = 2
    """Members of the global critic; the minimum counts, as in TD3. ours; 1 in `paper`: Eq. 4 has no minimum."""
    command_dims: int = 0
    """Leading actions whose leaky mean over the past stands behind φ's output; 0 disables it. ours: pixels hardly show the
    speed of an arm that lags behind its commands."""
    bank_size: int = 2048
    """Dataset latents kept with the model for anchors and support tests; 0 keeps nothing. ours; 0 in `paper`."""

    def __post_init__(self) -> None:
        require(1 <= self.frame_stack <= 16, "frame_stack", self.frame_stack, "1 to 16 frames")
        require(self.norm in get_args(Norm), "norm", self.norm, f"one of {get_args(Norm)}")
        for name in ("latent_dim", "n_global"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        for name in ("command_dims", "bank_size"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
