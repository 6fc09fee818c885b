"""`velap serve` and `velap export`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from velap.cli.options import ImageKey, joined
from velap.errors import ConfigError

Checkpoint = Annotated[Positional[Path], arg(help="`model.safetensors` of a run.")]
Device = Annotated[Literal["auto", "cpu", "cuda"], arg(help="`auto` takes CUDA where there is one.")]
KEY = "VELAP_API_KEY"
"""Environment variable with the key: on the command line every user of the machine could read it."""


def serve(checkpoint: Checkpoint, method: str = "velap", host: str = "127.0.0.1", port: int = 8000,
          image_key: ImageKey = (), device: Device = "auto", head: Path | None = None) -> None:
    """Serve a checkpoint to robots by openpi's websocket protocol, for `openpi-client`; see docs/how-to/real-robot.md.

    Clients send the key that the environment variable VELAP_API_KEY holds here.

    Args:
        method: VELAP or another method of `velap evaluate`.
        host: Address to listen on; one that other machines reach needs a key.
        port: Port to listen on.
        head: What the method learnt. Default: METHOD.safetensors beside the checkpoint.
    """
    import asyncio
    import logging

    try:
        from velap.serve.server import Server
    except ImportError as error:
        raise ConfigError(f"{error}; expected the packages of the server. Install them by `pip install 'velap[serve]'`."
                          ) from error
    from velap.cli import OUT
    from velap.serve.session import load_policy

    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    policy = load_policy(checkpoint, method, device, head)
    server = Server(policy, host=host, port=port, api_key=os.environ.get(KEY), image_key=joined(image_key))
    keyed = "clients need the key" if KEY in os.environ else f"without a key: {KEY} is not set"
    asyncio.run(server.run(lambda at: OUT.print(
        f"serving {checkpoint} ({method}) on ws://{host}:{at}, {keyed}; Ctrl-C ends it", markup=False, soft_wrap=True)))


def export(checkpoint: Checkpoint, out: Path = Path("exported"), tolerance: float = 1e-4) -> None:
    """Export encoder and policies as programs that run without velap, after comparing them with the model.

    Args:
        out: New folder that the programs go to.
        tolerance: Largest difference from the model's output that is let pass.
    """
    from velap.cli import OUT
    from velap.serve.export import export as run

    for name, program in run(checkpoint, out, tolerance).items():
        OUT.print(f"{out / program.file}: {name}({', '.join(program.inputs)}) -> {program.output}; "
                  f"at most {program.max_difference:.1g} from the model", markup=False, soft_wrap=True)
