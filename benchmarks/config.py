"""Options of the benchmarks' scripts, as dataclasses that ``conf/*.yaml`` are checked against."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

from hydra.core.config_store import ConfigStore

from nnode import config
from nnode.calibrate.options import Precision


@dataclass
class BenchmarkOptions:
    """What ``scripts/benchmark.py`` times, see :mod:`benchmarks.speed.run`."""

    # problems: paper | stress | effects | steps | tangents | crowd | crowd_effects
    # | people | scale | methods | diagnosis
    # the last two only if asked for
    shapes: list[str] = field(
        default_factory=lambda: [
            "paper",
            "stress",
            "effects",
            "steps",
            "tangents",
            "crowd",
            "crowd_effects",
            "people",
            "scale",
        ]
    )
    engines: list[str] | None = None  # null times all that cover a problem
    repeats: int = 5  # timings of each, of which the median counts
    restarts: int = 16  # of the ensemble
    # of the shape diagnosis: numbers of sequences, each diagnosed once in a process of its own
    sequences: list[int] = field(default_factory=lambda: [20, 100, 400, 1000])
    # of the timings; agreement is checked in float64
    dtype: Precision = Precision.float32
    redraw: str | None = None  # a benchmark.json to draw, and time nothing


@dataclass
class BenchmarkConfig:
    """``scripts/benchmark.py``: all engines on the same problems."""

    benchmark: BenchmarkOptions = field(default_factory=BenchmarkOptions)


@dataclass
class DiscoveryBenchmarkOptions:
    """The cases of ``scripts/benchmark_discovery.py``, see :mod:`benchmarks.discovery.run`."""

    # synthetic | rules (the same with other thresholds) | advice | laws | sumo | jupedsim
    # | recovery (parameters that are typed into programs, one case each)
    kinds: list[str] = field(default_factory=lambda: ["synthetic"])
    seeds: int = 10  # per effect, pair or fault, per law or scene
    first_seed: int = 0  # of the cases, while rules may still change
    # full hash of the commit that froze the rules; seeds follow from it
    seeds_of: str | None = None
    # of synthetic cases
    domains: list[str] = field(default_factory=lambda: ["traffic", "crowd"])  # or one of them
    # what is hidden: single | pair | nothing | outside | near_miss | no_excitation | fault;
    # null: all
    arms: list[str] | None = None
    effects: list[str] | None = None  # null: all; else only cases that hide one of these
    # null: all; of nothing: white | autocorrelated | windows | heterogeneous | recording
    variants: list[str] | None = None
    nothing_seeds: int = 400  # per variant of nothing
    strengths: list[str] = field(default_factory=lambda: ["medium"])  # weak medium strong full
    noises: list[float] | None = None  # m; null: 0.05 in traffic, 0.01 in crowds
    sizes: list[int] = field(default_factory=lambda: [20])  # numbers of platoons or crowds
    baseline_seeds: int = 3  # per effect, pair, ...: regressions on the same columns
    workers: int | None = None  # processes; null: one per core
    # address of a Dask scheduler, such as tcp://host:8786, whose workers do the work instead
    cluster: str | None = None


@dataclass
class DiscoveryBenchmarkConfig:
    """``scripts/benchmark_discovery.py``: the diagnosis on cases with a known truth."""

    benchmark_discovery: DiscoveryBenchmarkOptions = field(
        default_factory=DiscoveryBenchmarkOptions
    )


@dataclass
class FaultInjectionConfig:
    """``scripts/fault_injection.py``: misuse on purpose."""

    # what is tried: kills | disk | folder | fuzz
    campaigns: list[str] = field(default_factory=lambda: ["kills", "disk", "folder", "fuzz"])
    kills: int = 200  # over all jobs
    jobs: list[str] | None = None  # scripts that are tested; null: all that keep results
    repeats: int = 4  # second runs in a folder, per job
    inputs: int = 104000  # malformed files over all targets
    targets: list[str] | None = None  # what is given them; null: every reader and loader
    seed: int = 0  # of moments of kills and of malformed files


SCHEMAS = {
    "benchmark_schema": BenchmarkConfig,
    "benchmark_discovery_schema": DiscoveryBenchmarkConfig,
    "fault_injection_schema": FaultInjectionConfig,
}


@cache
def register() -> None:
    """Make all schemas known to Hydra, those of nnode too, once in a process."""
    config.register()
    store = ConfigStore.instance()
    for name, node in SCHEMAS.items():
        store.store(name=name, node=node)
