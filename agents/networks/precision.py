"""In which number format hidden layers train, and which formats a device multiplies quickly."""

from __future__ import annotations

import torch


def settle(precision: str, device: str) -> str:
    """``precision``, with ``auto`` replaced by its meaning on ``device``: results name the format that was used."""
    if precision != "auto":
        return precision
    return "bfloat16" if _multiplies_bfloat16(device) else "float32"


def hidden_dtype(precision: str, device: str) -> torch.dtype:
    """The format of hidden layers while a gradient is wanted."""
    return torch.bfloat16 if settle(precision, device) == "bfloat16" else torch.float32


def _multiplies_bfloat16(device: str) -> bool:
    """Whether the device has instructions for bfloat16 products; without them they are emulated, and slower."""
    if device == "cuda":
        return torch.cuda.is_bf16_supported()
    capabilities: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()  # older torch cannot tell
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16"))
