"""Compares the percentage of the live page with that of an audit, after some frames of a capture.

    python -m experiments.audit_live runs/kitchen-walk ../shared/recordings/hololens_lounge

The frames go through the guide as `r3jax audit --live` hands them over; an audit of as many frames
follows. Both ask how much of what a person sees from where one can stand is seen well enough.
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.pages.artifacts import joint_origin, markdown_table, write_markdown
from r3jax.apps.audit.audit import audit
from r3jax.apps.audit.live.follow import Guide
from r3jax.apps.audit.live.growing import Arrival, subset
from r3jax.apps.audit.live.guide_page import open_guide
from r3jax.apps.audit.settings import AuditSettings
from r3jax.apps.benchmark.record import machine
from r3jax.captures.source import Source, source_of
from r3jax.files import make_folder
from r3jax.formats.captures import open_capture

NAME = "audit_live"


@dataclasses.dataclass(frozen=True)
class Options:
    """Compares the live page with the audit."""

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Captures with depth."""

    frames: tuple[int, ...] = (10, 20, 40, 70)
    """After how many frames; no more than there are."""

    out: Path = Path("experiments/results") / NAME


def live_shares(source: Source, counts: list[int]) -> list[float]:
    """Shares on the live page after each of these numbers of frames."""
    found: list[float] = []
    with open_guide(port=0) as page, Guide(page) as guide:
        for index in range(max(counts)):
            first = subset(source, list(range(index + 1)))
            if guide.needs_anew(first):
                guide.forget()
                for before in range(index):
                    arrival = Arrival(source.labels[before], before, source.read(before))
                    guide.add(first, arrival, is_latest=False)
            arrival = Arrival(source.labels[index], index, source.read(index))
            guide.add(first, arrival, is_latest=True)
            if index + 1 in counts:
                answer = page.answer("news.json")
                assert answer is not None
                found.append(float(json.loads(answer[1])["fine_share"]))
    return found


def main(options: Options) -> None:
    """Follows and audits each capture, and writes the table."""
    rows: list[dict[str, Any]] = []
    for path in options.captures:
        capture = open_capture(path, "z")
        source = source_of(capture.source, capture.name)
        counts = sorted({min(count, len(source)) for count in options.frames})
        for count, live in zip(counts, live_shares(source, counts), strict=True):
            part = subset(source, list(range(count)))
            share = audit(part, AuditSettings(views=0)).diagnosis.fine_share
            rows.append({"capture": capture.name, "frames": count, "live [%]": round(100 * live),
                         "audit [%]": round(100 * share)})  # fmt: skip
            print(rows[-1], flush=True)
    make_folder(options.out)
    origin = joint_origin("experiments.audit_live", [machine()], [None])
    write_markdown(options.out / "table.md", [markdown_table(rows)], origin)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
