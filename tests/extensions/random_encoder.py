"""An encoder of another package: frozen random features of the shrunk pictures."""

import torch
from torch.nn.functional import avg_pool2d

import velap
from velap.models.encoders.base import Encoder

CELL = 8


@velap.register_encoder("random-features")
class RandomFeatures(Encoder):
    def __init__(self, config, size):
        super().__init__()
        inputs = 3 * config.frame_stack * (size[0] // CELL) * (size[1] // CELL)
        drawn = torch.randn(inputs, config.latent_dim, generator=torch.Generator().manual_seed(0))
        self.register_buffer("weight", drawn / inputs**0.5)

    def encode(self, stacks):
        pictures = stacks.flatten(0, 1).permute(0, 3, 1, 2).float() / 255
        cells = avg_pool2d(pictures, CELL).reshape(len(stacks), -1)
        return torch.tanh(4 * cells @ self.weight)
