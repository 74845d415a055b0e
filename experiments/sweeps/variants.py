"""Variants of a training run, and the jobs that train them: variants that differ only in traced fields share a job.

    OUT/runs/<variant>/         a run folder like that of `train`
    OUT/programs/<job>/         program.json, worker.log and the checkpoints of all its runs together

A variant is a list of options of `train`. So program.json is plain text, which any worker process can carry out.
"""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.config import relevant
from ccil_jax.demonstrations import minari_datasets
from ccil_jax.demonstrations.trajectories import Demonstrations, load_demonstrations
from ccil_jax.errors import DemonstrationsError
from ccil_jax.training.filesystem import content_sha256
from experiments.cli.command_line import UsageError
from experiments.cli.names import safe_name
from experiments.cli.settings_file import text
from experiments.runs import plans, run_folder
from experiments.runs.plans import RunPlan, static_values


@dataclasses.dataclass(frozen=True, kw_only=True)
class Variant:
    """One configuration with its seeds."""

    name: str  # also of its folder
    options: tuple[str, ...]  # of `train`, as they are typed
    plan: RunPlan
    alone: bool = False  # whether it needs a job of its own, so that its speed can be measured

    @property
    def finished(self) -> bool:
        """Whether its run folder is complete."""
        return (self.plan.folder / "summary.json").is_file()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """Variants that one process trains together, in one compiled program."""

    folder: Path
    variants: tuple[Variant, ...]


def make_variant(
    name: str,
    fields: Mapping[str, Any],
    out: Path,
    *,
    load: Callable[[Path], Demonstrations] = load_demonstrations,
    alone: bool = False,
) -> Variant:
    """Makes a variant.

    Args:
        name: of the variant and of its folder.
        fields: options of `train`, by name.
        out: folder of the whole study.
        load: reads a file of demonstrations. Give one with a cache where many variants share a file.
        alone: whether the variant needs a job of its own.

    Raises:
        UserError: an option is wrong.
    """
    if "demos" in fields:  # an absolute path, because a worker may be started in another folder
        try:
            fields = {**fields, "demos": minari_datasets.locate(fields["demos"]).resolve()}
        except DemonstrationsError as error:
            raise UsageError(f"--demos: {error}") from None
        except (TypeError, ValueError):
            raise UsageError(f"--demos {fields['demos']!r}: give the name of a file") from None
    return _variant(name, [f"--{field}={text(value)}" for field, value in fields.items()], out, load, alone=alone)


def _variant(
    name: str, given: Sequence[str], out: Path, load: Callable[[Path], Demonstrations], *, alone: bool = False
) -> Variant:
    folder = out / "runs" / name
    resume = (folder / "config.json").is_file()
    plan = plans.plan_of(plans.parse_options(given), folder, resume=resume, load=load)
    return Variant(name=name, options=tuple(given), plan=plan, alone=alone)


def check_unchanged(variant: Variant) -> None:
    """Raises `UsageError` where the variant's folder holds a run that was started with other choices."""
    plan, setup = variant.plan, variant.plan.setup
    if not plan.resume:
        return
    run = run_folder.read_run(plan.folder)
    run_folder.check_continues(run, f"--resume: {plan.folder}")
    names = ("task", "seed", "num_seeds", "eval_episodes", "env_options", "one_by_one")
    chosen = {**relevant(plan.config), **{name: getattr(setup, name) for name in names}}
    saved = {**run.facts, **dataclasses.asdict(run.config)}
    for name, value in chosen.items():
        if saved.get(name, value) != value:  # a folder of an older version may lack the name
            raise UsageError(f"--resume: {plan.folder} has {name} {saved[name]}, not {value}; choose another --out")
    demos = run.facts["demonstrations"]
    if demos and setup.demonstrations_path and content_sha256(setup.demonstrations_path) != demos["sha256"]:
        raise UsageError(f"--resume: {plan.folder} began with other demonstrations than {setup.demonstrations_path}")


def run_of(variant: Variant) -> Hashable:
    """What a variant trains, apart from its name and folder: two variants with equal values would train the same."""
    return variant.plan.setup, variant.plan.config


def group(variants: Iterable[Variant], out: Path) -> list[Job]:
    """The jobs that train these variants, in the order of their first variants."""
    groups: dict[Hashable, list[Variant]] = {}
    for variant in variants:
        program = variant.plan.setup, static_values(variant.plan.config)
        groups.setdefault((program, variant.name if variant.alone else ""), []).append(variant)
    return [_job(members, out) for members in groups.values()]


def _job(variants: Sequence[Variant], out: Path) -> Job:
    # The folder is named after the variants: a job with other variants is another program, which could not go on from
    # the checkpoints of this one.
    digest = hashlib.sha256(json.dumps([[v.name, v.options] for v in variants]).encode()).hexdigest()[:10]
    ((task, method),) = {(v.plan.setup.task, v.plan.config.method) for v in variants}
    return Job(folder=out / "programs" / f"{safe_name(task)}_{safe_name(method)}_{digest}", variants=tuple(variants))


def write_job(job: Job) -> None:
    """Makes the folders of a job and of its runs, and leaves program.json for its worker."""
    job.folder.mkdir(parents=True, exist_ok=True)
    for variant in job.variants:
        variant.plan.folder.mkdir(parents=True, exist_ok=True)
    variants = [{"name": v.name, "options": v.options} for v in job.variants]
    content = {"started_in": str(Path.cwd()), "variants": variants}
    run_folder.write_json(job.folder / "program.json", content)


def started_in(folder: Path) -> Path:
    """Where the sweep was started whose job is in `folder`: a user's own task or method may be a module there."""
    return Path(str(run_folder.read_json(folder / "program.json").get("started_in", ".")))


def read_job(folder: Path) -> Job:
    """The job that `write_job` left. Raises `UsageError` if it is missing or damaged."""
    content = run_folder.read_json(folder / "program.json")
    out = folder.parent.parent
    try:
        pairs = [(v["name"], v["options"]) for v in content["variants"]]
    except (KeyError, TypeError):
        raise UsageError(f"{folder}/program.json: damaged; repeat the sweep in another folder") from None
    load = functools.cache(load_demonstrations)
    return Job(folder=folder, variants=tuple(_variant(name, given, out, load) for name, given in pairs))
