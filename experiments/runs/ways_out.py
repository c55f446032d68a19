"""What to tell a user of a device without memory, in the words of what was called. No JAX here."""

from dataclasses import dataclass


@dataclass(frozen=True)
class WaysOut:
    """How what was called goes on, or else begins anew, with less memory.

    Attributes:
      with_chunks: how it goes on with chunks of `{chunk}` members.
      otherwise: what else there is to do.
    """

    with_chunks: str
    otherwise: str


_CHUNKS = "--mapping chunks --mapping-chunk {chunk}"

TRAIN = WaysOut(
    f"the same command goes on with --resume {_CHUNKS}",
    "more devices, or another --out with fewer agents, smaller batches (--batch-size), or --replay "
    "files if it is not",
)
GRID = WaysOut(
    f"the same command goes on with {_CHUNKS}",
    "more devices, or another folder of results (--results) with smaller batches (--batch-size), "
    "or --replay files if it is not",
)
WORK = WaysOut(
    f"the same command goes on with {_CHUNKS}",
    "more devices; smaller batches are for the command that plans, in another folder",
)
DEMO = WaysOut(
    f"the same command goes on with {_CHUNKS}",
    "more devices, or another folder (--results) with fewer agents (--seeds, --omegas)",
)
CALL = WaysOut(
    'the same call goes on with mapping="chunks", mapping_chunk={chunk}',
    "more devices, or another folder with fewer agents, smaller batches (batch_size=…), or "
    'replay="files" if it is not',
)
