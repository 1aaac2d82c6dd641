"""Why there is no plan: what is impossible, which limit binds, what to change."""

from __future__ import annotations

from station.plan.candidates import Pool
from station.plan.scene import Scene


def explain_shortage(scene: Scene, wanted: int, best: Pool) -> str:
    """One paragraph for a person."""
    lines = [f"Only {len(best)} of the wanted {wanted} poses are possible."]
    for reason, count in best.lost.most_common(3):
        if count:
            lines.append(f"{count} candidates fell to: {reason}.")
    return " ".join(lines)
