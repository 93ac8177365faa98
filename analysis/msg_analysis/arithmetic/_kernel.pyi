from collections.abc import Sequence

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray

def combine(weights: Sequence[float], payloads: Sequence[bytes], drive: bytes, /) -> bytes: ...
def all_finite(payload: bytes, /) -> bool: ...
def advance(
    order: IntArray,
    offsets: IntArray,
    columns: IntArray,
    weights: FloatArray,
    modes: IntArray,
    drives: FloatArray,
    states: FloatArray,
    agents: int,
    replicas: int,
    links: IntArray | bytes = b"",
    first: IntArray | bytes = b"",
    senders: IntArray | bytes = b"",
    ahead: IntArray | bytes = b"",
    delay: int = 0,
    lost: BoolArray | bytes = b"",
    broadcast: FloatArray | bytes = b"",
    link: FloatArray | bytes = b"",
    held: FloatArray = ...,
    /,
) -> None: ...
