"""Writes the tables about the learner TD3, as Markdown."""

from docs._generate.results import Row, bench_rows, count, fixed, mean, of_seeds, rate, read_json, seconds, trials
from docs._generate.tables import markdown, reward, steps_told
from hgail_jax.settings.defaults import DEFAULTS

_RUNS = (
    *("reach-td3", "push-td3", "pick-and-place-td3", "pick-and-place-td3-no-reward", "slide-td3"),
    *("stack-td3", "tower-td3", "grasp-td3"),
    *(f"{task}-hgail" for task in ("reach", "push", "pick-and-place", "slide", "grasp")),
)
_TRIALS = "suite/off-policy"
_ON_TWO_CORES = ("push", "pick_and_place", "grasp", "slide", "stack")
_WITH_WEIGHTS = ("reach", "grasp", "push", "pick-and-place", "slide", "stack", "tower")


def off_policy() -> str:
    """Eight seeds of each task by either learner."""
    header = ["task", "learner", "reward", "success", "worst seed", "steps to .95", "all steps", "training"]
    return markdown([*header, "whole run"], [_run(name) for name in _RUNS])


def _run(name: str) -> list[str]:
    row = read_json(f"runs/{name}/summary")
    return [
        row["task"],
        row.get("learner", "ppo").upper(),
        reward(row),
        of_seeds(row["success_rate"]),
        fixed(min(row["success_rate"]["per_seed"]), 3),
        steps_told(name),
        count(row["env_steps_per_seed"]),
        *(seconds(row["wall_seconds"][part]) for part in ("train", "total")),
    ]


def off_policy_cpu() -> str:
    """One seed of each task on two cores."""
    runs = [read_json(_TRIALS)[f"{task}_on_two_cores"] for task in _ON_TWO_CORES]
    return markdown(
        ["task", "reward", "success", "env steps", "whole run"],
        [
            [
                run["task"],
                reward(run),
                fixed(run["success_rate"]["mean"], 3),
                count(run["env_steps_per_seed"]),
                seconds(run["wall_seconds"]["total"]),
            ]
            for run in runs
        ],
    )


def off_policy_rewards() -> str:
    """Weight of the goal test in each task's reward by default, by platform."""
    return markdown(["task", "w on a GPU", "w on a CPU"], [[task, *_weights(task)] for task in _WITH_WEIGHTS])


def _weights(task: str) -> list[str]:
    presets = DEFAULTS[task]["td3"]
    return [f"{presets[platform].hyperparameters.environment_reward:g}" for platform in ("gpu", "cpu")]


def off_policy_parts(task: str, study: str = "off-policy") -> str:
    """Success of a task with TD3, a part left out or changed; a row that is no change has its own name too."""
    rows = trials(f"{study}-{task}")
    as_it_is, *others = rows
    alike = [row for row in others if row["identity"] == as_it_is["identity"]]
    return markdown(
        ["setting", "success", "worst seed", "steps to .95", "L1 distance"],
        [
            [
                f"as it is, {row['setting']}" if row in alike else row["setting"],
                fixed(row["success_rate"], 3),
                fixed(row["worst_seed"], 3),
                _steps_told(row["curves"]),
                f"{fixed(100 * row['distance_l1'], 1)} cm",
            ]
            for row in (others if alike else rows)
        ],
    )


def _steps_told(curves: Row) -> str:
    """Returns the steps of a seed after which the mean of the seeds was first measured at .95, as a table has it."""
    reached = zip(curves["env_steps"], curves["success"], strict=True)
    return next((count(steps) for steps, success in reached if mean(success) >= 0.95), "never")


def off_policy_updates(task: str) -> str:
    """Time of an update phase by parts."""
    parts = ("update_phase", "rollout_phase", "gradient_steps", "discriminator", "bare_optimiser")
    header = [
        "seeds",
        "environments each",
        "a phase",
        "its roll-out",
        "gradient steps",
        "the discriminator's",
        "bare optimiser",
    ]
    sizes = ("seeds", "num_envs_per_seed")
    rows = sorted(
        (row for row in bench_rows("updates") if row["task"] == task), key=lambda row: [row[s] for s in sizes]
    )
    return markdown(
        header,
        [
            [*(count(row[size]) for size in sizes), *(f"{fixed(row[f'{part}_seconds'], 2)} s" for part in parts)]
            for row in rows
        ],
    )


def off_policy_seeds(task: str) -> str:
    """Time of a round as seeds are added to the program."""
    rows = [row for row in bench_rows("seeds") if row["task"] == task]
    header = ["seeds", "a round", "in rounds of one seed", "env steps per second"]
    return markdown(
        header,
        [
            [
                count(row["seeds"]),
                seconds(row["round_seconds"]),
                fixed(row["cost_in_rounds_of_one_seed"], 2),
                rate(row["train_env_steps_per_second"]),
            ]
            for row in rows
        ],
    )


def off_policy_trials(name: str, every: int = 2) -> str:
    """Returns the success of settings that one program trained side by side, after some of its rounds."""
    (trial,) = (program for program in read_json(_TRIALS)["programs"] if program["name"] == name)
    shown = [point for index, point in enumerate(trial["curve"]) if index % every == 0 or point is trial["curve"][-1]]
    shown = shown[1:]
    header = ["setting", *(f"{round(point['env_steps'] / 1000)} k" for point in shown)]
    return markdown(
        header,
        [
            [setting, *(_mean_and_worst(point, index) for point in shown)]
            for index, setting in enumerate(trial["settings"])
        ],
    )


def off_policy_on_two_cores() -> str:
    """Trials of settings for a CPU, one seed each."""
    header = ["task", "setting", "env steps", "training", "success in the last three tests"]
    return markdown(
        header,
        [
            [
                row["task"],
                row["setting"],
                count(row["env_steps"]),
                seconds(row["seconds"]),
                ", ".join(fixed(each, 2) for each in row["success_of_the_last_three_tests"]),
            ]
            for row in read_json(_TRIALS)["on_two_cores"]["rows"]
        ],
    )


def _mean_and_worst(point: Row, index: int) -> str:
    if "mean_and_worst" in point:
        average, worst = point["mean_and_worst"][index]
    else:
        average, worst = mean(point["success"][index]), min(point["success"][index])
    return f"{fixed(average, 2)} ({fixed(worst, 2)})"


def update_times() -> str:
    """Milliseconds of a gradient step of TD3, by the way in which XLA multiplies matrices."""
    rows = read_json(_TRIALS)["update_milliseconds"]["rows"]
    return markdown(["matrix products", "ms a step"], [[name, fixed(value, 2)] for name, value in rows])
