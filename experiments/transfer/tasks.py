"""Entries of each task in the tables and pictures, besides its environment in `hgail_envs`."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Task:
    """Task of transferred policies."""

    paper_success: float | None
    """Success rate that the paper reports on the real UR5; None if it reports none."""
    paper_distance_l1: float | None
    """L1 distance that the paper reports there, metres."""
    pictured_steps: tuple[int, ...]
    """Steps to draw of an episode; -1 is the last, lift test included."""
    seen_by_cameras: bool = True
    """True if cameras can see the target: a ball that is put there, or the cube."""


TASKS = {
    "reach": Task(paper_success=0.95, paper_distance_l1=0.01, pictured_steps=(0, 2, 4, 6, 10, -1)),
    "grasp": Task(paper_success=0.93, paper_distance_l1=0.02, pictured_steps=(0, 3, 5, 8, 50, -1)),
    "pick-and-place": Task(None, None, pictured_steps=(0, 3, 6, 9, 12, -1), seen_by_cameras=False),
}
"""The tasks of the tables, curves and pictures, by their names in `hgail_envs.TASKS`; a robot may do others too."""
