"""Checks a user's task against the interface, method by method, before anything is compiled for it."""

import inspect
import traceback
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs.base import EpisodeMetrics, GoalEnv, State
from hgail_envs.validation import check_count, check_positive

_BATCH = (2, 3)
"""Leading axes for methods that must take any."""
_EPISODES = 2  # one would hide a mistake in the batch's axis
_COUNTS = dict.fromkeys(("episode_length", "feature_size", "goal_size", "action_size", "goal_kinds"), 1)
_COUNTS["lift_test_steps"] = 0
_NUMBERS = ("success_threshold", "observation_limit", "control_period")

_NOT_TRACEABLE = (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError)
_HINTS: dict[tuple[type[Exception], ...], str] = {
    _NOT_TRACEABLE: "it uses NumPy, or Python's if, float or int, on an array that JAX traces;"
    " use jax.numpy, jnp.where and jax.lax",
    (jax.errors.UnexpectedTracerError,): "it uses an array that another call kept, on self for instance;"
    " carry it in the physics state",
}

_Shapes = Any
"""A pytree of `jax.ShapeDtypeStruct`."""


def check_task(env: GoalEnv) -> None:
    """Checks a task against the interface that the learner relies on, e.g. in a test of a user's task.

    Each method is traced alone, so that the message names the method with the mistake, and then two environments are
    reset and take one step.

        def test_my_task():
            hgail_envs.check_task(MyTask())

    Raises:
      ValueError: an attribute is missing or out of range, or a method raises, or returns other shapes than `GoalEnv`
        documents. The message names it, its value and the value that is needed.

    >>> from hgail_envs.point import Point
    >>> check_task(Point())
    >>> class Flat(Point):
    ...     feature_size = 2
    >>> check_task(Flat())
    Traceback (most recent call last):
    ValueError: Flat.features gives float32 [3]; it must give float32 [2], that is [feature_size]
    """
    if not isinstance(env, GoalEnv):
        raise ValueError(f"{env!r} is not a GoalEnv; a task is an instance of a subclass of hgail_envs.GoalEnv")
    _check_attributes(env)
    _check_methods(env)
    _check_episode(env)


def _check_attributes(env: GoalEnv) -> None:
    for name in (*_COUNTS, *_NUMBERS):
        value, owner = getattr(env, name, None), f"{type(env).__name__}.{name}"
        if value is None:
            raise ValueError(f"{owner} is missing; set it in the class")
        if name in _COUNTS:
            check_count(owner, value, _COUNTS[name])
        else:
            check_positive(owner, value)


def _check_methods(env: GoalEnv) -> None:
    """Traces each method on the shapes that the methods before it returned."""
    rng, flag = jax.eval_shape(lambda: jax.random.key(0)), jax.ShapeDtypeStruct((), bool)
    step, action = jax.ShapeDtypeStruct((), jnp.int32), _floats(env.action_size)
    physics = _trace(env, "reset_physics", rng)
    plan = _trace(env, "plan_goals", rng, physics, flag)
    _check_same(env, "step_physics", physics, _trace(env, "step_physics", physics, action))
    _check_array(env, "features", (physics,), _floats(env.feature_size), "[feature_size]")
    _check_array(env, "achieved_goal", (physics,), _floats(env.goal_size), "[goal_size]")
    _check_array(env, "sample_goal", (rng, physics), _floats(env.goal_size), "[goal_size]")
    _check_array(env, "current_goal", (plan, physics, step), _floats(env.goal_size), "[goal_size]")
    _check_array(env, "lift_test_action", (action,), action, "[action_size]")
    _check_array(env, "overflow", (physics,), flag, "one number")
    for batch in ((), _BATCH):  # hindsight calls these for whole trajectories
        features, goal = _floats(*batch, env.feature_size), _floats(*batch, env.goal_size)
        observations = _floats(*batch, env.observation_size)
        flags, kinds = (jax.ShapeDtypeStruct(batch, dtype) for dtype in (bool, jnp.int32))
        _check_array(env, "goal_observation", (features, goal), observations, "[..., observation_size]")
        _check_array(env, "success", (goal, goal), flags, "[...]")
        _check_array(env, "goal_test", (features, goal, goal), flags, "[...]")
        _check_array(env, "goal_kind", (goal,), kinds, "[...]")
        _check_array(env, "already_solved", (features, goal), flags, "[...]")


def _check_episode(env: GoalEnv) -> None:
    """Takes a step in two environments, and checks the states."""
    resets = jax.vmap(env.reset, in_axes=(0, None))
    count = _EPISODES if env.max_worlds is None else min(_EPISODES, env.max_worlds)
    rngs = jax.random.split(jax.random.key(0), count)
    state = _run(env, "reset", lambda: jax.jit(resets)(rngs, True))
    _check_state(env, "reset", state)
    action = jnp.zeros((count, env.action_size))
    following = _run(env, "step", lambda: jax.jit(jax.vmap(env.step))(state, action))
    _check_state(env, "step", following)
    _check_same(env, "step", jax.eval_shape(lambda: state), jax.eval_shape(lambda: following), like="reset")
    outcome = _run(
        env, "outcome", lambda: jax.eval_shape(jax.vmap(lambda *ends: env.outcome(*ends)), *2 * (following,))
    )
    needed = jax.tree.map(lambda _: _floats(count), EpisodeMetrics())
    _check_same(env, "outcome", needed, outcome, like="GoalEnv.outcome")


def _check_state(env: GoalEnv, name: str, state: State) -> None:
    """Checks that a state is finite, and that its observation is rebuilt from its parts, as hindsight does."""
    owner = f"{type(env).__name__}.{name}"
    for part in ("features", "achieved_goal", "desired_goal"):
        if part not in state.info:
            raise ValueError(f"{owner} gives a State without info[{part!r}]; hindsight needs it")
        values = np.asarray(state.info[part])
        if not np.isfinite(values).all():
            raise ValueError(f"{owner} gives a State whose info[{part!r}] is not finite: {values[0]}")
    rebuilt = np.asarray(env.goal_observation(state.info["features"], state.info["desired_goal"]))
    if rebuilt.shape != state.obs.shape or not np.allclose(rebuilt, np.asarray(state.obs), rtol=1e-5, atol=1e-6):
        raise ValueError(
            f"{owner} gives a State whose obs is not goal_observation(info['features'], info['desired_goal']);"
            " hindsight rebuilds it so for other goals"
        )


def _floats(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def _trace(env: GoalEnv, name: str, *arguments: _Shapes) -> _Shapes:
    """Returns the shapes that a method gives for arguments of these shapes."""
    # A new lambda each time: JAX's cache of earlier traces would hide a mistake.
    return _run(env, name, lambda: jax.eval_shape(lambda *given: getattr(env, name)(*given), *arguments))


def _run(env: GoalEnv, name: str, call: Callable[[], Any]) -> Any:
    """Returns the result of `call`; turns its exceptions into a ValueError that names the method and the line."""
    try:
        return call()
    except Exception as error:  # a user's task may raise any
        reason = next((hint for kinds, hint in _HINTS.items() if isinstance(error, kinds)), None)
        if reason is None:
            reason = f"{type(error).__name__}: {next(iter(str(error).strip().splitlines()), '')}"
        raise ValueError(f"{type(env).__name__}.{name} fails{_line(env, error)}: {reason}") from error


def _line(env: GoalEnv, error: Exception) -> str:
    """Returns the line of the task's own files that raised an error, as text for a message."""
    files = {inspect.getsourcefile(base) for base in type(env).__mro__ if base.__module__.split(".")[0] not in _FOREIGN}
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename in files]
    return f" ({own[-1].filename}:{own[-1].lineno})" if own else ""


_FOREIGN = ("abc", "brax", "builtins", "hgail_envs")  # packages of a task's bases that its author does not edit


def _check_array(env: GoalEnv, name: str, arguments: tuple[_Shapes, ...], needed: _Shapes, meaning: str) -> None:
    """Refuses a method that gives another shape or dtype than `needed`, whose `meaning` is for the message."""
    given = _trace(env, name, *arguments)
    if not isinstance(given, jax.ShapeDtypeStruct) or (given.shape, given.dtype) != (needed.shape, needed.dtype):
        raise ValueError(
            f"{type(env).__name__}.{name} gives {_describe(given)}; it must give {_describe(needed)}, that is {meaning}"
        )


def _check_same(env: GoalEnv, name: str, needed: _Shapes, given: _Shapes, like: str = "reset_physics") -> None:
    """Refuses trees of other structure, shapes or dtypes than `needed`, which the method `like` returned."""
    owner = f"{type(env).__name__}.{name}"
    if len({jax.tree.structure(tree) for tree in (needed, given)}) > 1:
        raise ValueError(f"{owner} gives {_describe(given)}; it must give what {like} does, {_describe(needed)}")
    paths = jax.tree_util.tree_leaves_with_path(needed)
    for (path, before), after in zip(paths, jax.tree.leaves(given), strict=True):
        if (before.shape, before.dtype) != (after.shape, after.dtype):
            where = jax.tree_util.keystr(path)
            raise ValueError(
                f"{owner} gives {_describe(after)}{where and ' for ' + where}; it must give what {like} does,"
                f" {_describe(before)}"
            )


def _describe(given: _Shapes) -> str:
    if isinstance(given, jax.ShapeDtypeStruct):
        return f"{given.dtype} [{', '.join(map(str, given.shape))}]"
    return " ".join(str(jax.tree.map(lambda leaf: _describe(leaf), given)).split())
