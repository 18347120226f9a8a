"""The student: who acts, what the teacher labels, and what is learnt from pictures."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import KINDS
from hgail_jax import Config, Hyperparameters, init_state, phase_table, train_step
from hgail_jax.learners.student import OBJECT_SCALE, Student, _fit, _Lesson
from hgail_jax.rollout import rollout
from hgail_jax.seeds import init_seeds, seed_keys
from hgail_jax.vision.augmentation import AUGMENTATIONS, Augmentation
from hgail_jax.vision.network import init_eyes, look
from tests.hgail_jax.vision.scenes import Map, poses, push, teacher

STUDENT = Student(mixed=4, updates=3, batch=16, channels=(4, 4, 4, 4))
CONFIG = Config(
    STUDENT, num_envs=8, rounds=2, training_goals=False, discriminator_minibatches=0, policy_hidden=(16, 16)
)
HYPER = Hyperparameters(exploration_noise=0.1, policy_learning_rate=1e-3, environment_reward=1.0)


@functools.cache
def untrained():
    return jax.jit(lambda rng: init_state(push(), CONFIG, HYPER, rng))(jax.random.key(0))


def after(rollouts, hyper=HYPER):
    state = untrained()
    learner = state.learner.replace(steps=jnp.asarray(rollouts * STUDENT.updates))
    return state.replace(learner=learner, hyperparameters=hyper.as_arrays())


@functools.cache
def rolled():
    """A roll-out with the teacher in half the episodes, without noise, and the state it was made by."""
    state = after(2, HYPER.replace(exploration_noise=1e-9))
    policy = STUDENT.policy(push(), CONFIG, state, 1.0)
    return state, jax.jit(lambda rng: rollout(push(), policy, rng, CONFIG.num_envs))(jax.random.key(1))


fit = jax.jit(_fit, static_argnums=(0, 1))


@jax.jit
def drawn(qpos):
    """Returns the pictures of joint positions, `[count, nq]`."""
    return push().pictures(qpos, jnp.zeros((len(qpos), 1)))


@jax.jit
def lesson_of(learner, trajectory):
    return STUDENT.lesson(push(), learner, trajectory)


def test_labels_are_the_teachers_actions_and_it_acts_in_its_share_of_the_episodes():
    state, trajectory = rolled()
    lesson = lesson_of(state.learner, trajectory)
    observation = np.concatenate([trajectory.features, trajectory.desired], axis=-1)[:-1]
    expected = teacher()(observation)
    np.testing.assert_allclose(lesson.action, expected, atol=1e-4)
    apart = np.abs(trajectory.action - expected).max(axis=(0, 2))
    assert (apart[:4] < 1e-4).all() and (apart[4:] > 1e-2).all()


def test_a_lesson_shows_the_state_that_acted():
    state, trajectory = rolled()
    lesson = lesson_of(state.learner, trajectory)
    cube = push().features_layout["cube position"]
    places = np.asarray(trajectory.features[:-1][..., cube])
    assert np.abs(np.diff(places, axis=0)).max() > 5e-3  # metres that a cube moves in a step
    np.testing.assert_allclose(lesson.objects * OBJECT_SCALE, places, atol=1e-5)
    x, y = np.moveaxis((places[..., :2] - [1.1, 0.5]) / 0.5 * 16, -1, 0)
    bright = np.asarray(lesson.pictures[:, :, 0, :, :, 0]).reshape(50, 8, -1).argmax(axis=-1)
    assert np.abs(bright % 16 + 0.5 - x).max() < 1.0 and np.abs(bright // 16 + 0.5 - y).max() < 1.0
    numbers = np.asarray(lesson.numbers)
    np.testing.assert_array_equal(numbers[..., :3], trajectory.features[:-1, :, :3])
    np.testing.assert_array_equal(numbers[..., -4:], trajectory.desired[:-1])


@pytest.mark.parametrize(("rollouts", "share"), [(0, 1.0), (1, 0.75), (4, 0.0), (9, 0.0)])
def test_the_teacher_leaves(rollouts, share):
    assert STUDENT.teacher_share(after(rollouts).learner) == share


def test_the_student_alone_is_evaluated():
    state = after(0)
    observation = jax.jit(jax.vmap(push().reset))(jax.random.split(jax.random.key(0), 8)).obs
    act = jax.jit(lambda observation, rng: STUDENT.policy(push(), CONFIG, state, 0.0)(observation, rng))
    action, _ = act(observation, jax.random.key(0))
    numbers = observation[:, push().known]
    pictures = np.float32(push().see(observation)) / 255.0
    np.testing.assert_allclose(action, jax.jit(look)(state.learner.eyes, pictures, numbers)[0], atol=1e-5)


def test_it_learns_to_predict_where_the_cube_is():
    qpos = poses(128)
    env = push()
    cube = qpos[:, env.task.qpos_of("cube")]
    lesson = _Lesson(
        pictures=drawn(qpos),
        numbers=np.zeros((len(qpos), 2)),
        objects=(cube - cube.mean(axis=0)) / OBJECT_SCALE,
        action=np.zeros((len(qpos), 4)),
        weight=np.ones(len(qpos)),
    )
    eyes = jax.jit(lambda rng: init_eyes(rng, 1, 2, (4, 4, 4, 4), (32,), (4, 3)))(jax.random.key(0))
    zero = jax.tree.map(np.zeros_like, eyes)
    optimizer = untrained().learner.optimizer._replace(mu=zero, nu=zero)
    sizes, rng = Student(updates=80, batch=24), jax.random.key_data(jax.random.key(1))
    eyes, _, _ = fit(sizes, Augmentation(), eyes, optimizer, lesson, rng, 2e-2)
    unseen = poses(64, seed=1)
    pictures = np.float32(drawn(unseen)) / 255.0
    predicted = np.asarray(jax.jit(look)(eyes, pictures, np.zeros((64, 2)))[1]) * OBJECT_SCALE + cube.mean(axis=0)
    error = np.abs(predicted - unseen[:, env.task.qpos_of("cube")])[:, :2].mean()
    assert error < 0.01  # metres, of cubes within 12 cm around the middle


def test_episodes_that_broke_down_teach_nothing():
    state, trajectory = rolled()
    broken = trajectory.replace(valid=trajectory.valid.at[3].set(False), features=trajectory.features.at[:, 3].set(7.0))
    update = jax.jit(functools.partial(STUDENT.begin, push(), CONFIG))
    one, metrics = update(state, broken, jax.random.key(2))
    other, _ = update(state, broken.replace(features=broken.features.at[:, 3].set(-7.0)), jax.random.key(2))
    assert np.isfinite(metrics["action_error"])
    for name in ("mean", "std", "centre"):
        np.testing.assert_array_equal(getattr(one.learner, name), getattr(other.learner, name))
    jax.tree.map(np.testing.assert_array_equal, one.learner.eyes, other.learner.eyes)
    moved = jax.tree.map(lambda after, before: np.abs(after - before).max(), one.learner.eyes, state.learner.eyes)
    assert max(jax.tree.leaves(moved)) > 1e-4  # the others teach


def test_a_look_varies_the_pictures_that_are_learnt_from():
    qpos, env, learner = poses(16), push(), untrained().learner
    lesson = _Lesson(
        pictures=drawn(qpos),
        numbers=np.zeros((16, len(env.known))),
        objects=np.zeros((16, 3)),
        action=np.zeros((16, 4)),
        weight=np.ones(16),
    )

    def learnt(name):
        rng = jax.random.key_data(jax.random.key(0))
        sizes = Student(updates=1, batch=8), AUGMENTATIONS["colour"][name]
        eyes, _, _ = fit(*sizes, learner.eyes, learner.optimizer, lesson, rng, 1e-3)
        return eyes.convolutions[0][0]

    plain = learnt("plain")
    np.testing.assert_array_equal(learnt("cameras"), plain)  # whose pictures vary by the scene alone
    assert np.abs(learnt("varied") - plain).max() > 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_the_kind_and_the_look_of_pictures_decide_how_they_are_varied(kind, monkeypatch):
    given, pictures = [], Map(push().task, kind=kind)
    pictures.look = "varied"

    def fit(sizes, augmentation, eyes, optimizer, *_):
        given.append(augmentation)
        return eyes, optimizer, {}

    monkeypatch.setattr("hgail_jax.learners.student._fit", fit)
    STUDENT.update(CameraEnv(push().task, pictures, push().teacher), CONFIG, *rolled(), jax.random.key(0))
    assert set(given) == {AUGMENTATIONS[kind]["varied"]}


def test_without_their_weight_the_positions_teach_nothing():
    env, learner = push(), untrained().learner
    lesson = _Lesson(
        pictures=drawn(poses(16)),
        numbers=np.zeros((16, len(env.known))),
        objects=np.ones((16, 3)),
        action=np.ones((16, 4)),
        weight=np.ones(16),
    )

    def learnt(weight):
        sizes, rng = Student(updates=2, batch=8, object_weight=weight), jax.random.key_data(jax.random.key(0))
        return fit(sizes, Augmentation(), learner.eyes, learner.optimizer, lesson, rng, 1e-3)[0]

    before, without, with_them = learner.eyes, learnt(0.0), learnt(1.0)
    jax.tree.map(np.testing.assert_array_equal, without.objects, before.objects)
    assert np.abs(with_them.objects[1] - before.objects[1]).max() > 1e-4
    assert np.abs(without.action[1] - before.action[1]).max() > 1e-4  # the actions do
    with pytest.raises(ValueError, match=r"object_weight is -1\.0; it must be at least 0"):
        Student(object_weight=-1.0)


def test_a_round_can_be_traced():
    state, phases = untrained(), phase_table(CONFIG)[1]
    after_it, metrics = jax.eval_shape(functools.partial(train_step, push(), CONFIG), state, phases)
    assert jax.tree.map(jnp.shape, after_it) == jax.tree.map(jnp.shape, state)
    assert metrics.training.success.shape == ()


@pytest.mark.slow
def test_a_seed_learns_as_it_does_beside_another():
    many = jax.jit(jax.vmap(functools.partial(train_step, push(), CONFIG), in_axes=(0, None)))

    def train(first):
        states = init_seeds(push(), CONFIG, HYPER, seed_keys(first, 2))
        for phases in phase_table(CONFIG)[:2]:
            states, _ = many(states, phases)
        return states.learner

    second, first = train(2), train(3)
    for one, other in zip(jax.tree.leaves(second), jax.tree.leaves(first), strict=True):
        np.testing.assert_array_equal(one[1], other[0])
    assert np.abs(first.eyes.convolutions[0][0][0] - first.eyes.convolutions[0][0][1]).max() > 1e-2


def test_a_student_needs_pictures_and_a_teacher():
    with pytest.raises(ValueError, match="a student needs a task with pictures and a teacher: --observe camera"):
        init_state(hgail_envs.make("point"), CONFIG, HYPER, jax.random.key(0))
