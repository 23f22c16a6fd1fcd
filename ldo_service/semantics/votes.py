"""What speaks for each name of a region, and the name that most speaks for.

The detector's boxes have votes, and so have the answers of a labeller, each of its guesses by how
sure it is: of two it can hardly choose between, the next answer decides.
"""

Votes = tuple[tuple[str, float, float], ...]  # name, sum of its votes, the surest of them


def with_vote(votes: Votes, name: str, sure: float, weight: float = 1.0) -> Votes:
    """What is twice as sure counts four times. Of the demo's boxes that are 0.3 sure a third are
    right, of those that are 0.6 sure all but few.

    >>> votes = with_vote((("tv", 0.25, 0.5),), "tv", 0.6)
    >>> with_vote(votes, "oven", 0.5, weight=4)
    (('tv', 0.61, 0.6), ('oven', 1.0, 0.5))
    """
    return _added(votes, ((name, weight * sure**2, sure),)) if name else votes


def with_box(votes: Votes, name: str, sure: float, most: float) -> Votes:
    """As above, up to `most` in all: a box comes with every keyframe, and says the same again.

    >>> with_box(with_box((), "tv", 0.6, 0.4), "tv", 0.5, 0.4)
    (('tv', 0.4, 0.6),)
    """
    if not name or most <= 0:
        return votes
    had = next((total for one, total, _ in votes if one == name), 0.0)
    return _added(votes, ((name, min(sure**2, max(most - had, 0.0)), sure),))


def with_votes_of(votes: Votes, others: Votes, share: float) -> Votes:
    """With those of another region, of which 0..1 this is a `share`.

    >>> with_votes_of((("clock", 1.0, 0.5),), (("radiator", 2.0, 0.8), ("clock", 0.5, 0.4)), 0.5)
    (('clock', 1.25, 0.5), ('radiator', 1.0, 0.4))
    """
    return _added(votes, tuple((name, share * total, share * most) for name, total, most in others))


def favourite(votes: Votes, least: float) -> tuple[str, float]:
    """What most speaks for, and how sure: as the surest was, by the share of all votes that are for
    it; nothing where the sum is less than `least`.

    >>> favourite((("tv", 0.6, 0.5), ("oven", 0.4, 0.6)), 0.35)
    ('tv', 0.3)
    """
    name, total, most = max(votes, key=lambda vote: vote[1], default=("", 0.0, 0.0))
    if total == 0 or total < least:
        return "", 0.0
    return name, most * total / sum(one for _, one, _ in votes)


def _added(votes: Votes, more: Votes) -> Votes:
    sums = {name: (total, most) for name, total, most in votes}
    for name, total, most in more:
        before, surest = sums.get(name, (0.0, 0.0))
        sums[name] = before + total, max(surest, most)
    return tuple((name, *both) for name, both in sums.items())
