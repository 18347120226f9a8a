"""FetchPush: push a cube to a place on the table."""

from hgail_envs.tasks import controllers
from hgail_envs.tasks.layouts import ACTION_OF_ARM, GRIPPER, of_object
from hgail_envs.tasks.objects import GOAL, ObjectEnv


class Push(ObjectEnv):
    """FetchPush: push a cube to a place on the table, with closed fingers.

    The start is the reference's, see `docs/tasks.md`; unlike there, the table has no edge from which the cube could
    fall.

    TD3 needs the waypoints of `ObjectEnv` (`docs/lab/off-policy.md`), PPO only in `Slide` (`docs/lab/ppo.md`).

    See `ObjectEnv` for the meaning of a goal, success and the arguments.
    """

    features_layout, goal_layout = GRIPPER + of_object("cube"), GOAL
    action_layout = ACTION_OF_ARM

    start_height = 0.0
    object_name = object_title = "cube"
    object_range = 0.15
    target_range = 0.15

    scene = "push"
    instruction = "Push the cube to the target."
    reference = "FetchPush-v4"
    controllers = (features_layout + goal_layout).readers({"from-behind": controllers.push})
