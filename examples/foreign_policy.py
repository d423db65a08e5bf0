"""A policy that is a program of its own, in plain NumPy: looks where it has looked least.

    r3jax explore --scene flat --policy "exec:python examples/foreign_policy.py" --budget views:20

Reads messages from its input, writes answers to its output, and needs nothing of r3jax: the same
lines work in any language. How the bytes lie is in docs/howto/policy.md.
"""

import json
import struct
import sys

import numpy as np


def receive():
    """Returns the next message: its header and its arrays by name; None at the end."""
    prefix = sys.stdin.buffer.read(8)
    if len(prefix) < 8:
        return None
    header = json.loads(sys.stdin.buffer.read(struct.unpack("<II", prefix)[0]))
    arrays = {}
    for entry in header["arrays"]:
        dtype = np.dtype(entry["dtype"]).newbyteorder("<")
        data = sys.stdin.buffer.read(dtype.itemsize * int(np.prod(entry["shape"])))
        arrays[entry["name"]] = np.frombuffer(data, dtype).reshape(entry["shape"])
    return header, arrays


def send(**answer):
    """Sends an answer without arrays."""
    header = json.dumps(answer).encode()
    sys.stdout.buffer.write(struct.pack("<II", len(header), 0) + header)
    sys.stdout.buffer.flush()


def main():
    """Greets, then answers every question with the number of a candidate."""
    receive()  # hello: camera, bounds, motion, seed
    send(kind="hello", protocol=1, name="least-looked-at")
    seen = np.zeros((0, 3))
    while (message := receive()) is not None:
        question, arrays = message
        if "T_world_camera" in arrays:  # frames since the last question; rgb and depth beside it
            seen = np.concatenate([seen, arrays["T_world_camera"][:, :3, 2]])
        looked = np.exp(4.0 * (arrays["direction"] @ seen.T)).sum(axis=1)
        best = int(np.argmin(np.log(looked) + 0.5 * arrays["path"]))
        send(kind="candidate", index=best, view=question["view"])


if __name__ == "__main__":
    main()
