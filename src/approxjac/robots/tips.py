"""Links of a branched robot that its user may mean by the tip."""

from __future__ import annotations

from approxjac.robots.urdf import Urdf

_USUAL = ("tool0", "tcp", "_ee_link", "end_effector", "eef", "tool", "flange", "gripper", "hand")
_MANY = 12  # ends that are told


def likely_tips(urdf: Urdf) -> str:
    """Return a clause that offers the links that are called as tips are, and the ends."""
    moved = [link for link in urdf.links if link in urdf.moved_links]
    ranks = {}
    for link in moved:
        name = f"_{link.lower()}"
        words = [k for k, word in enumerate(_USUAL) if word in name]
        if words and "finger" not in name:
            # of two with the same word the shorter name is that of the whole thing
            ranks[link] = words[0], len(link)
    likely = sorted(ranks, key=ranks.__getitem__)[:5]
    carriers = {joint.parent for joint in urdf.joints.values()}
    ends = [link for link in moved if link not in carriers]
    more = f" and {len(ends) - _MANY} more" if len(ends) > _MANY else ""
    told = f"ends are {', '.join(ends[:_MANY])}{more}"
    return f"likely tips are {', '.join(likely)}; {told}" if likely else told
