"""Values that no run can have, drawn at random; every one is refused by name before anything is traced."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hgail_envs
from hgail_envs.validation import MOST
from hgail_jax import PPO, TD3, Config, Hyperparameters, evaluate, init_state, relabel, rollout
from hgail_jax.evaluate import whole_rollouts
from hgail_jax.learners import LEARNERS
from hgail_jax.seeds import seed_keys

many = settings(max_examples=300, deadline=None, derandomize=True, database=None)
no_number = st.one_of(st.none(), st.text(), st.lists(st.text(), min_size=1), st.just({}), st.complex_numbers())
no_integer = st.one_of(no_number, st.floats(), st.booleans())
MAY_BE_0 = ("rounds", "policy_phases", "discriminator_phases", "bc_batch", "discriminator_minibatches")
COUNTS = {
    sizes: {field.name: int(field.name not in MAY_BE_0) for field in dataclasses.fields(sizes) if field.type is int}
    for sizes in (Config, *LEARNERS.values())
}
SHARES = ("p_ht", "environment_reward", "discount", "gae_lambda", "standardize_reward")
POSITIVE = (
    "exploration_noise",
    "final_exploration_noise",
    "clip_ratio",
    "policy_learning_rate",
    "discriminator_learning_rate",
)


def outside(least, most):
    return st.one_of(st.integers(max_value=least - 1), st.integers(min_value=most + 1))


no_share = st.one_of(no_number, st.floats().filter(lambda value: not 0.0 <= value <= 1.0), outside(0, 1))
not_positive = st.one_of(
    no_number,
    st.floats(max_value=0.0),
    st.floats(min_value=1e39),
    st.sampled_from([float("nan"), 1e-60]),  # which is 0 in single precision
)
no_widths = st.one_of(
    no_integer, st.lists(st.integers(1, 9)), st.tuples(st.integers(1, 9), no_integer), st.tuples(outside(1, MOST))
)


@many
@given(
    bad=st.one_of(
        *(
            st.tuples(st.just(sizes), st.just(name), no_integer | outside(least, MOST))
            for sizes, counts in COUNTS.items()
            for name, least in counts.items()
        ),
        st.tuples(st.just(PPO), st.just("pretrain"), st.one_of(no_number, st.integers(), st.floats())),
        st.tuples(st.sampled_from([*LEARNERS.values()]), st.just("final_learning_rate"), no_share),
        st.tuples(st.just(Config), st.sampled_from(["policy_hidden", "discriminator_hidden"]), no_widths),
    )
)
def test_bad_sizes_are_refused_by_name(bad):
    sizes, name, value = bad
    given = {"learner": PPO()} if sizes is Config else {}
    with pytest.raises(ValueError, match=name) as error:
        sizes(**given, **{name: value})
    assert len(str(error.value).splitlines()) == 1
    config = Config(PPO()) if sizes is Config else Config(learner=sizes())
    with pytest.raises(ValueError, match=name):
        config.replace(**{name: value})


@many
@given(
    bad=st.one_of(
        st.tuples(st.sampled_from(SHARES), no_share),
        st.tuples(st.sampled_from(POSITIVE), not_positive),
        st.tuples(st.sampled_from(["strategy"]), no_number | outside(0, 1) | st.just(0.5)),
        st.tuples(st.sampled_from(["reward"]), no_number | outside(0, 3) | st.just(float("nan"))),
    )
)
def test_bad_hyperparameters_are_refused_by_name(bad):
    name, value = bad
    with pytest.raises(ValueError, match=name) as error:
        init_state(hgail_envs.make("point"), Config(PPO()), Hyperparameters(**{name: value}), jax.random.key(0))
    assert len(str(error.value).splitlines()) == 1


@many
@given(
    learner=st.sampled_from([*LEARNERS.values()]),
    draw=st.data(),
    share=st.floats(0.0, 1.0),
    positive=st.floats(1e-30, 1e30),
    widths=st.lists(st.integers(1, MOST), max_size=4).map(tuple),
)
def test_good_values_are_taken(learner, draw, share, positive, widths):
    least = COUNTS[Config] | COUNTS[learner]
    counts = {name: st.integers(value, MOST) for name, value in least.items()}
    changes = draw.draw(st.fixed_dictionaries({}, optional=counts)) | {
        "final_learning_rate": share,
        "policy_hidden": widths,
        "discriminator_hidden": widths,
    }
    before = Config(learner=learner()).as_dict()
    own = {name: changes.get(name, value) for name, value in before.pop("learner").items()}
    expected = {name: changes.get(name, value) for name, value in before.items()} | {"learner": own}
    assert Config(learner=learner()).replace(**changes).as_dict() == expected
    for good in (
        Hyperparameters(p_ht=share),
        Hyperparameters(exploration_noise=positive, reward=3, include_current=True),
    ):
        assert good.validate() is good


@pytest.mark.parametrize(
    ("name", "value"),
    [("tau", 1.5), ("epsilon", -0.1), ("target_noise", -1.0), ("negative_p_ht", 2.0), ("discriminator_horizon", 0)],
)
def test_bad_hyperparameters_of_a_learner_s_own_are_refused_by_name(name, value):
    good = TD3.hyperparameters()
    with pytest.raises(ValueError, match=f"{name} is {value}; it must be"):
        good.replace(**{name: value}).validate()
    assert good.replace(p_ht=0.5).validate().p_ht == 0.5


def test_hyperparameters_may_be_arrays_and_tracers():
    Hyperparameters(p_ht=jnp.array(0.5), discount=np.float32(0.5)).validate()
    with pytest.raises(ValueError, match="p_ht"):
        Hyperparameters(p_ht=jnp.array([0.5, 1.5])).validate()
    swept = jax.vmap(lambda p_ht: Hyperparameters(p_ht=p_ht).validate().p_ht)(jnp.array([0.0, 1.0]))
    np.testing.assert_array_equal(swept, [0.0, 1.0])


@pytest.mark.parametrize("learner", LEARNERS.values(), ids=LEARNERS)
def test_whole_numbers_stand_for_floats(learner):
    usual = learner.hyperparameters()
    floats = [field.name for field in dataclasses.fields(usual) if isinstance(field.default, float)]
    arrays = usual.replace(**dict.fromkeys(floats, np.int64(1))).as_arrays()

    assert {name: getattr(arrays, name).dtype for name in floats} == dict.fromkeys(floats, jnp.float32)
    assert all(getattr(arrays, name) == 1 for name in floats)
    assert arrays.strategy.dtype == jnp.int32 and arrays.include_current.dtype == bool
    assert usual.replace(exploration_noise=(1, 1)).as_arrays().exploration_noise.dtype == jnp.float32


def test_minibatches_must_not_outnumber_samples():
    env = hgail_envs.make("point")
    Config(num_envs=2, learner=PPO(minibatches=100)).validate(env)
    with pytest.raises(ValueError, match="minibatches is 101; it must be at most 100"):
        Config(num_envs=2, learner=PPO(minibatches=101)).validate(env)
    with pytest.raises(ValueError, match="is not a GoalEnv"):
        Config(PPO()).validate("point")


def test_a_config_is_changed_by_the_names_of_its_own_fields_and_of_its_learner_s():
    given = Config(rounds=3, learner=PPO(epochs=5))
    changed = Config(num_envs=8, rounds=3, learner=PPO(epochs=5, minibatches=2))
    assert given.replace(num_envs=8, minibatches=2) == changed
    assert given.replace(num_envs=8, learner=PPO(epochs=9), minibatches=2, epochs=5) == changed
    assert given == Config(rounds=3, learner=PPO(epochs=5))
    with pytest.raises(ValueError, match="Config has no field 'phases', nor has the learner ppo"):
        given.replace(phases=2)
    for learner in ("ppo", None, Config(PPO())):
        with pytest.raises(ValueError, match=r"learner is .*; it must be a learner with its sizes"):
            Config(learner=learner)


@pytest.mark.parametrize(
    ("first", "count", "message"),
    [(0, 0, "seeds is 0"), (-1, 2, "first_seed is -1"), (2**31 - 1, 1, "first_seed"), (0.0, 1, "integer")],
)
def test_bad_seeds_are_refused(first, count, message):
    with pytest.raises(ValueError, match=message):
        seed_keys(first, count)


def test_no_episodes_are_refused():
    env, key = hgail_envs.make("point"), jax.random.key(0)
    for call in (
        lambda: evaluate(env, None, key, 0),
        lambda: rollout(env, None, key, -1),
        lambda: rollout(env, None, key, 2.5),
        lambda: whole_rollouts(0, 64),
    ):
        with pytest.raises(ValueError, match="must be"):
            call()


@pytest.mark.parametrize(
    ("achieved", "desired", "p_ht"),
    [((5,), (3,), 1.0), ((5, 3), (2,), 1.0), ((1, 3), (3,), 1.0), ((5, 3), (3,), 1.5), ((5, 3), (3,), float("nan"))],
)
def test_relabelling_refuses_what_does_not_fit(achieved, desired, p_ht):
    with pytest.raises(ValueError, match="must be"):
        relabel(jax.random.key(0), jnp.zeros(achieved), jnp.zeros(desired), p_ht)
