"""Commercial cars on a track, and people behind automated cars."""

from __future__ import annotations

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import paired
from nnode.pages.page import Block, FigureBlock, Heading, TableBlock, Text
from studies.following import figures as plots
from studies.following import leaders, printed
from studies.following.page_precision import UNITS
from studies.following.results import Study

#: Settings of the distance in their order; people drive without.
SETTINGS = {"min": "ACC, min", "max": "ACC, max", "none": "people"}


def platoon_blocks(study: Study) -> list[Block]:
    """OpenACC."""
    found = {
        key.removeprefix("platoon-"): one
        for key, one in study.found.items()
        if key.startswith("platoon-")
    }
    makes = next(iter(found.values()))["makes"]
    again = study.found["reproduced-platoon"]
    table = pd.DataFrame({"printed": printed.PLATOON_ERRORS, "here": again["stopped"]})
    table["difference"] = table["here"] - table["printed"]
    table["the law alone"] = pd.Series(again["law"])
    table.loc["mean"] = table.mean()
    table.index.name = "follower"
    chosen = min(found, key=lambda n: float(np.mean(found[n]["chosen"])))
    own = [min(found, key=lambda n: found[n]["chosen"][i]) for i in range(len(makes))]
    rows = {}
    for name in sorted(found, key=lambda n: float(np.mean(found[n]["chosen"]))):
        one = found[name]
        rows[name.replace("-", " + ").replace("_", " ")] = {
            "fold": float(np.mean(one["chosen"])),
            "first 70 %": float(np.mean(one["train"])),
            "last 30 %": float(np.mean(one["heldout"])),
            **dict(zip(makes, one["heldout"], strict=True)),
            "at a limit": sum(map(len, one["limits"])),
        }
    each = [found[n]["heldout"][i] for i, n in enumerate(own)]
    rows["chosen by follower"] = {
        "fold": float(np.mean([found[n]["chosen"][i] for i, n in enumerate(own)])),
        "last 30 %": float(np.mean(each)),
        **dict(zip(makes, each, strict=True)),
    }
    rows["ovm, printed"] = {
        "last 30 %": float(np.mean(list(printed.PLATOON_ERRORS.values()))),
        **printed.PLATOON_ERRORS,
    }
    compared = pd.DataFrame(rows).T
    compared.index.name = "law"
    bold = pd.DataFrame(False, index=compared.index, columns=compared.columns)
    bold.loc[chosen.replace("-", " + ").replace("_", " "), ["fold", "last 30 %"]] = True
    text = (
        f"OpenACC, AstaZero, run {printed.PLATOON}: each of four followers with adaptive cruise "
        "control behind its measured leader, calibrated on the first 70 % of the samples. The law "
        "is chosen without the rest: calibrated on the first 70 % of those 70 %, judged on what "
        f"remains of them. That is *{chosen.replace('-', ' + ').replace('_', ' ')}*, with "
        f"{np.mean(found[chosen]['heldout']):.2f} m on the last 30 %, a mean of four followers; "
        f"printed for optimal velocity: {np.mean(list(printed.PLATOON_ERRORS.values())):.2f} m. "
        f"Chosen for each follower by itself: {np.mean(each):.2f} m. One platoon, "
        "one run, one stretch held out: the order of laws is what it shows of these four cars."
    )
    return [
        Heading("Commercial cars on a track"),
        Text(text),
        TableBlock(
            "platoon_published",
            table,
            "Root mean square error of the gap (m) on the last 30 %: printed, and what the "
            "published parameters of the optimal-velocity model give here, the follower's gap and "
            "speed held where it would collide, as there. They do collide: *the law alone* drives "
            "on with a gap below 0.1 m, as all laws do below.",
            digits=4,
        ),
        TableBlock(
            "platoon",
            compared,
            "Root mean square error of the gap (m), mean over four followers and each by itself on "
            "the last 30 %; *fold*: inside the first 70 %, by which the law is chosen. *At a "
            "limit*: how many of the four followers' parameters ended at one.",
            bold=bold,
            digits={"at a limit": 0},
        ),
        *_runs(study),
    ]


def _runs(study: Study) -> list[Block]:
    one = study.found["runs"]
    frame = pd.DataFrame(
        {"run": one["runs"], "make": one["makes"], "setting": one["settings"]}
        | {"error (m)": one["costs"]}
    ).join(pd.DataFrame(one["parameters"]))
    frame["at a limit"] = [", ".join(found) for found in one["limits"]]
    frame["setting"] = [SETTINGS.get(s, s) for s in frame["setting"]]
    order = [s for s in SETTINGS.values() if (frame["setting"] == s).any()]
    rows = {
        s: {
            "followers": int((frame["setting"] == s).sum()),
            **{
                what: float(getattr(frame.loc[frame["setting"] == s, "T"], what)())
                for what in ("min", "median", "max")
            },
            "error (m)": float(frame.loc[frame["setting"] == s, "error (m)"].mean()),
        }
        for s in order
    }
    table = pd.DataFrame(rows).T
    table.index.name = "setting"
    values = {
        s: {
            make: frame.loc[(frame["setting"] == s) & (frame["make"] == make), "T"].to_numpy()
            for make in sorted(set(frame["make"]))
        }
        for s in order
    }
    return [
        TableBlock(
            "time_gaps",
            table,
            f"Time gap T (s) of idm, calibrated on every follower of all {frame['run'].nunique()} "
            "runs by itself, by the setting of the distance.",
            digits={"followers": 0},
            full=frame,
        ),
        FigureBlock(
            "time_gaps",
            plots.by_group(values, "time gap T (s)"),
            "Time gap of idm by setting and make, one point per follower and run.",
            "Time gaps by distance setting and make.",
        ),
    ]


def leader_blocks(study: Study) -> list[Block]:
    """TGSIM."""
    one = study.found["leaders"]
    names, kind = one["names"], np.array(one["kinds"])
    label = np.array(one["clusters"])
    rows = {}
    for i, name in enumerate(names):
        row: dict[str, object] = {"unit": UNITS.get(name, "1")}
        values = {k: np.array(one["rows"][k]) for k in leaders.KINDS}
        out = {k: np.array(one["without"][k]) for k in leaders.KINDS}
        for k in leaders.KINDS:
            _, half = leaders.jackknifed(values[k], out[k])
            row |= {k: values[k][i], f"± {k}": half[i]}
        away = values["CAV"] - values["HV"]
        _, half = leaders.jackknifed(away, out["CAV"] - out["HV"])
        rows[name] = row | {
            "CAV minus HV": away[i],
            "from": away[i] - half[i],
            "to": away[i] + half[i],
        }
    table = pd.DataFrame(rows).T
    table.index.name = "parameter"
    sure = [n for n in names if float(table.loc[n, "from"]) * float(table.loc[n, "to"]) > 0]
    held = {k: np.array(v) for k, v in one["heldout"].items()}
    judged = {}
    for k in leaders.KINDS:
        on = kind == k
        for source in ("both", *leaders.KINDS):
            away = paired(held[source][on], held["both"][on], _dense(label[on]), study.options.seed)
            judged[(f"behind {k}", f"calibrated on {source}")] = {
                "pairs": int(on.sum()),
                "held out (m)": held[source][on].mean(),
                "minus both": away.difference,
                "from": away.low,
                "to": away.high,
            }
    costs = pd.DataFrame(judged).T
    costs.index.names = ["pairs", ""]
    speed, gap = np.array(one["speed"]), np.array(one["gap"])
    text = (
        f"TGSIM: {int((kind == 'HV').sum())} pairs of people behind people (HV) and "
        f"{int((kind == 'CAV').sum())} behind automated cars (CAV) in {label.max() + 1} clusters, "
        "each with both kinds. idm, all pairs of a kind together; intervals leave out one cluster "
        "after the other (jackknife, Student's t). "
        + (
            f"Differences whose interval excludes 0: {', '.join(sure)}."
            if sure
            else "No parameter's difference has an interval that excludes 0."
        )
        + f" Followers behind people drive {speed[kind == 'HV'].mean():.1f} m/s with gaps of "
        f"{gap[kind == 'HV'].mean():.1f} m on average, behind automated cars "
        f"{speed[kind == 'CAV'].mean():.1f} m/s and {gap[kind == 'CAV'].mean():.1f} m: who leads "
        "is not drawn by lot, and a difference may be one of place and time."
    )
    return [
        Heading("People behind people, and behind automated cars"),
        Text(text),
        TableBlock(
            "leaders",
            table,
            "Parameters of idm by kind of leader, half widths of 95 % intervals (±), and the "
            "difference with its interval.",
        ),
        TableBlock(
            "leaders_heldout",
            costs,
            "Error of the gap (m) on pairs of a cluster that was left out, by what was calibrated "
            "on; differences to one calibration for both kinds, clusters resampled.",
            digits={"pairs": 0},
        ),
    ]


def _dense(label: np.ndarray) -> np.ndarray:
    return np.asarray(np.unique(label, return_inverse=True)[1])
