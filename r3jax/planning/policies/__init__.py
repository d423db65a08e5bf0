"""One file per policy. Their names are known without importing them."""

from r3jax.foreign.choices import did_you_mean

HOMES = {
    "ours": "renderability.Ours",
    "ours-pano": "renderability.OursPano",
    "ours-demand": "demand.OursDemand",
    "ours-ahead": "ahead.OursAhead",
    "active-gs": "active_gs.ActiveGS",
    "active-gs-no-depth": "active_gs.ActiveGSNoDepth",
    "active-gamer": "active_gamer.ActiveGamer",
    "cover": "cover.Cover",
    "unseen": "unseen.Unseen",
    "unseen-depth": "unseen.UnseenDepth",
    "frontier": "frontier.Frontier",
    "uniform": "uniform.Uniform",
    "random": "random.Random",
}
"""Of every policy the file and the class."""


def check_policy(name: str) -> None:
    """Refuses a name that no policy has.

    Raises:
        ValueError: names the known ones, and the one that was meant.
    """
    if name not in HOMES:
        hint = did_you_mean(name, HOMES)
        raise ValueError(f"unknown policy {name!r}{hint}; known: {', '.join(HOMES)}")
