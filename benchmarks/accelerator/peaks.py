"""How fast cards multiply matrices at most, as their makers say: dense, without sparsity."""

import re

PEAKS = {
    # JAX multiplies float32 as TensorFloat-32 on NVIDIA cards, and as bfloat16 on TPUs, unless it
    # is told otherwise.
    "NVIDIA A100": (156.0, 312.0),
    "NVIDIA H100 PCIe": (378.0, 756.0),
    "NVIDIA H100 NVL": (417.0, 835.0),
    "NVIDIA H100": (494.0, 989.0),
    "NVIDIA H200 NVL": (417.0, 835.0),
    "NVIDIA H200": (494.0, 989.0),
    "NVIDIA L4": (60.0, 121.0),
    "NVIDIA L40S": (183.0, 362.0),
    "TPU v4": (275.0, 275.0),
    "TPU v5 lite": (197.0, 197.0),
    "TPU v5": (459.0, 459.0),
    "TPU v6 lite": (918.0, 918.0),
}
"""Beginning of the name that JAX gives a card -> TFLOP/s in float32 and in bfloat16."""


def known_peaks(card: str) -> tuple[float, float] | None:
    """TFLOP/s of a card in float32, as JAX multiplies it by default, and in bfloat16.

    Args:
      card: what JAX calls it, such as "NVIDIA H100 80GB HBM3".

    Returns:
      None where they are not known.
    """
    words = re.split("[ -]", card)
    if "MIG" in words:  # a part of a card
        return None
    # The longest name first, and whole words: an L40S is no L4.
    for name in sorted(PEAKS, key=len, reverse=True):
        if words[: len(name.split())] == name.split():
            return PEAKS[name]
    return None
