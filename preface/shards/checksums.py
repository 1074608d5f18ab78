"""CRC-32C of views and tables, and the digest that a manifest carries of itself."""

from __future__ import annotations

import hashlib
import re

import google_crc32c
import numpy as np

# A digest within the text that it digests: it is computed with 64 zeros in its own place.
_DIGEST = re.compile(rb'("digest": ")([0-9a-f]{64})(")')
NO_DIGEST = "0" * 64


def crc32c(data: bytes | np.ndarray, start: int = 0) -> int:
    """The CRC-32C (Castagnoli, RFC 3720) of bytes or of a contiguous array, continued from `start`."""
    if isinstance(data, np.ndarray):
        data = np.ascontiguousarray(data).reshape(-1).view(np.uint8)
    return google_crc32c.extend(start, data)


def text_digest(text: bytes) -> tuple[str | None, str]:
    """The digest that a text declares, None if it does not declare exactly one, and the one that it should.

    Both are 64 hexadecimal digits, the second the SHA-256 of the text with zeros where the first stands.
    """
    declared = _DIGEST.findall(text)
    blank = _DIGEST.sub(rb"\g<1>" + NO_DIGEST.encode() + rb"\g<3>", text)
    actual = hashlib.sha256(blank).hexdigest()
    return (declared[0][1].decode() if len(declared) == 1 else None), actual
