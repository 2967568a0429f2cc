"""What the benchmark of scans found, as tables and charts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from lidarops.bench.accuracy import multiangle_cases as cases
from lidarops.bench.accuracy import multiangle_scores as scores
from lidarops.bench.accuracy.homogeneous import MonteCarloFigure
from lidarops.bench.accuracy.homogeneous_report import facts
from lidarops.bench.accuracy.multiangle_scores import (
    MultiAngle,
    OutlierScore,
    PublishedCloudScore,
    SafetyScore,
    ScanScore,
    SceneScore,
    measure_multiangle,
)
from lidarops.bench.harness.terms import RESULT, Effort, Finding, Kind
from lidarops.bench.throughput.retrievals import READ, StepCost
from lidarops.bench.throughput.scan_kernels import (
    INPUTS,
    MultiAngleThroughput,
    measure_scan_kernels,
)
from lidarops.figures.charts import Chart, Ladder, Panel, Series, pareto
from lidarops.figures.wording import counted, percent
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table

_NONE: Final = "-"
_GAIN: Final = 0.98
"""A smaller gain in RMSE is Monte Carlo noise."""
_PER_KM: Final = 1e3
_UNDRAWN: Final = "mld 0, sum over angles"
"""Next to `mld 0, discrepancy` in clear air, behind it in clouds."""
_ERRORS: Final = (
    "In brackets: Monte Carlo standard error of the last digits, of independent blocks."
)


def run_multiangle(kind: Kind, *, effort: Effort) -> Finding:
    """Run a benchmark of the retrieval from scans.

    Parameters
    ----------
    kind : Kind
    effort : Effort
    """
    if kind is Kind.ACCURACY:
        found = measure_multiangle(quick=effort.quick, date=effort.date, progress=effort.progress)
        return Finding(found, multiangle_accuracy_report(found, RESULT))
    timed = measure_scan_kernels(
        quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
    )
    return Finding(timed, multiangle_throughput_report(timed, RESULT))


def multiangle_accuracy_report(found: MultiAngle, data: str = "") -> BenchmarkReport:
    """Return the page of the accuracy benchmark."""
    return BenchmarkReport(
        title="Scans: error of optical depth and extinction against CPU time",
        facts=facts(found.date, found.machine),
        parts=(
            _scenes(found.scenes),
            _published(found),
            _outliers(found.outliers),
            _safety(found.safety),
        ),
        data=data,
    )


def multiangle_throughput_report(found: MultiAngleThroughput, data: str = "") -> BenchmarkReport:
    """Return the page of the throughput benchmark."""
    return BenchmarkReport(
        title="Scans: time per profile",
        facts=facts(found.date, found.machine),
        parts=(_times(found),),
        data=data,
    )


# All ways in four scenes ----------------------------------------------------------------------


def _scenes(found: Sequence[SceneScore]) -> Part:
    return Part(
        title="Error against CPU time",
        text="Clear air: 12 beams from 0 to 75°, evenly spaced in slant path, 201 altitudes from "
        "150 m to 6.15 km, scatter of backscatter along the horizontal 3 %, signal over noise as "
        "stated at the zenith in 1 km. Cloud: 6 beams from 0 to 30°, 40 altitudes, optical depth "
        "4.4, scatter 14.7 %, independent or correlated by 0.8 between altitudes. All profiles "
        "of a block are solved at once, and share inhomogeneity, smoothness and truth. Ours find "
        "the scatter themselves; the peers are told it, work altitude by altitude, and take each "
        "sample that exceeds 3 times its noise, which picks the bright ones: that is the bias of "
        "lstsq in clear air, from which the mean signal of a window of altitudes keeps ours. "
        "mld: order of the penalty and choice of its strength.",
        charts=(
            _work_chart(found, "optical-depth", "optical depth", ""),
            _work_chart(found, "extinction", "extinction", " (km⁻¹)"),
        ),
        tables=tuple(_scene_table(scene) for scene in found),
    )


def _work_chart(found: Sequence[SceneScore], name: str, quantity: str, unit: str) -> Chart:
    return Chart(
        name=f"work-{name}",
        title=f"Error of {quantity} against CPU time",
        caption=f"Root mean square error of {quantity}, bars of 2 Monte Carlo standard errors; "
        "hollow: peers. The line joins the ways that no other beats in both.",
        panels=tuple(
            Panel(
                title=scene.label,
                x_label="CPU time per profile (ms)",
                y_label="" if number else f"error of {quantity}{unit}",
                series=tuple(_point(one, name) for one in _drawn(scene)),
                front=pareto(
                    [(one.nanoseconds / 1e6, _rmse(one, name).value) for one in _drawn(scene)],
                    _GAIN,
                ),
            )
            for number, scene in enumerate(found)
        ),
    )


def _drawn(scene: SceneScore) -> list[ScanScore]:
    return [one for one in scene.scores if one.way != _UNDRAWN]


def _rmse(score: ScanScore, name: str) -> MonteCarloFigure:
    if name == "extinction":
        return scaled(score.extinction_rmse, _PER_KM)
    return score.rmse


def _point(score: ScanScore, name: str) -> Series:
    rmse = _rmse(score, name)
    low = max(rmse.value - 2.0 * rmse.error, 0.1 * rmse.value)
    return Series(
        score.way,
        (score.nanoseconds / 1e6,),
        (rmse.value,),
        (low,),
        (rmse.value + 2.0 * rmse.error,),
        hollow=score.way in cases.scan_peers(),
    )


def _scene_table(scene: SceneScore) -> Table:
    return Table(
        title=f"{scene.label}, {counted(scene.profiles, 'profile')}",
        columns=(
            "way",
            "profiles",
            "ms each",
            "solved",
            "RMSE",
            "mean error",
            "at the top",
            "within 1",
            "within 1.96",
            "extinction RMSE (km⁻¹)",
            "within 1",
            "within 1.96",
            "data share",
        ),
        rows=tuple(
            (
                one.way,
                f"{one.profiles:,}",
                f"{one.nanoseconds / 1e6:.3g}",
                percent(one.solved),
                with_error(one.rmse),
                with_error(one.bias, sign=True),
                _NONE if one.top_bias is None else with_error(one.top_bias, sign=True),
                *_shares(one.coverage),
                with_error(scaled(one.extinction_rmse, _PER_KM)),
                *_shares(one.extinction_coverage),
                _NONE if one.data_share is None else f"{one.data_share:.2f}",
            )
            for one in scene.scores
        ),
        note=f"{_ERRORS} Within 1 and 1.96 stated standard errors: 68.3 and 95 % where errors are "
        "as stated. At the top: mean error at the highest altitude. Extinction: RMSE of all "
        "differences of optical depths; coverage of what is published, which leaves out what "
        "comes less than 90 % from the data. Data share: median; the rest is zero for mld 0, the "
        "altitude below for mld_prior.",
    )


def _shares(coverage: tuple[MonteCarloFigure, MonteCarloFigure] | None) -> tuple[str, str]:
    if coverage is None:
        return _NONE, _NONE
    low, high = (with_error(scaled(one, 100.0)) for one in coverage)
    return f"{low} %", f"{high} %"


# The published experiment ---------------------------------------------------------------------


def _published(found: MultiAngle) -> Part:
    every = found.published
    return Part(
        title="The published experiment",
        text=_verdict(found),
        charts=(_angle_chart(every),),
        tables=(
            *(_published_table(every, angle, *scores.CENTRAL) for angle in (15.0, 30.0)),
            _prior_table(found),
            _correlation_table(found),
        ),
        details=tuple(
            _published_table(every, angle, beams, share)
            for beams in scores.PUBLISHED_BEAMS
            for share in scores.PUBLISHED_SHARES
            for angle in (15.0, 30.0)
            if (beams, share) != scores.CENTRAL
        ),
    )


def _verdict(found: MultiAngle) -> str:
    def one(way: str, angle: float) -> PublishedCloudScore:
        return next(
            score
            for score in found.published
            if (score.way, score.largest_angle) == (way, angle)
            and (score.beams, score.share) == scores.CENTRAL
        )

    mld, alone = one("mld 0, discrepancy", 15.0), one(scores.TWO_ANGLE_ALONE, 30.0)
    plain, joint = one(cases.KANO_HAMILTON, 15.0), one(cases.JOINT, 15.0)
    filtered, nothing = one(cases.MLD_PRIOR, 15.0), one(scores.NOTHING, 15.0)
    alike = max(found.correlations, key=lambda score: (score.correlation, score.way == cases.JOINT))
    enough = [
        angle
        for angle in scores.PUBLISHED_ANGLES
        if one("mld 0, discrepancy", angle).rmse.value <= alone.rmse.value
    ]
    reached = f"from {enough[0]:g}° on" if enough else "at none of the angles tried"
    times = mld.rmse.value / alone.rmse.value
    return (
        "A cloud of 8 layers of 50 m, optical depth 4.4, seen along 6 or 4 evenly spaced angles; "
        "backscatter is off by up to 20 to 30 % from beam to beam and layer to layer. Published "
        "(in a figure, without a number) is that the regularised derivative is stable at 15°, "
        "where two angles, shown for 30° and 10 %, are not acceptable. Of single altitudes, this "
        f"{'is not so' if times > 1.0 else 'is so'}: with 25 % at 15°, mld of order 0 is off by "
        f"{with_error(mld.rmse)}, {times:.1f} times the {with_error(alone.rmse)} of two angles at 30° with "
        f"10 %. Stable it is, as an answer of zero is ({nothing.rmse.value:.2f}): it gains "
        f"{percent(1.0 - mld.rmse.value / plain.rmse.value)} on the straight line, "
        f"{with_error(plain.rmse)}, with an error of {mld.top_bias.value:+.2f} at the top and a median "
        f"of {percent(mld.data_share or 0.0)} of the answer from the data; the rest is the prior, "
        "and so is its error (table of priors). The shape of two-angle profiles is another "
        f"matter: {percent(1.0 - alone.monotone)} of those at 30° decrease somewhere. Errors "
        f"as small as those of two angles at 30° with 10 % it reaches {reached}. With the "
        "altitude below as prior, the second published scheme, it is off by "
        f"{with_error(filtered.rmse)} at 15°. What helps there is smoothness over altitude: joint is "
        f"off by {with_error(joint.rmse)}, and by {with_error(alike.rmse)} where layers scatter alike."
    )


def _angle_chart(found: Sequence[PublishedCloudScore]) -> Chart:
    central = [one for one in found if (one.beams, one.share) == scores.CENTRAL]
    ways = (
        scores.NOTHING,
        scores.TWO_ANGLE_ALONE,
        cases.KANO_HAMILTON,
        "mld 0, discrepancy",
        cases.MLD_PRIOR,
        cases.JOINT,
    )
    drawn = {way: [one for one in central if one.way == way] for way in ways}
    return Chart(
        name="angles",
        title="Published experiment: error against the largest zenith angle",
        caption="6 beams, backscatter off by up to 25 % (10 % where stated).",
        panels=(
            Panel(
                title="optical depth",
                x_label="largest zenith angle (degree)",
                y_label="root mean square error",
                series=tuple(
                    Series(
                        way,
                        tuple(one.largest_angle for one in points),
                        tuple(one.rmse.value for one in points),
                        joined=True,
                    )
                    for way, points in drawn.items()
                ),
                x_log=False,
            ),
            Panel(
                title="share of the data",
                x_label="largest zenith angle (degree)",
                y_label="median share",
                series=tuple(
                    Series(
                        way,
                        tuple(one.largest_angle for one in points if one.data_share is not None),
                        tuple(one.data_share for one in points if one.data_share is not None),
                        joined=True,
                    )
                    for way, points in drawn.items()
                ),
                x_log=False,
            ),
        ),
    )


def _published_table(
    found: Sequence[PublishedCloudScore], angle: float, beams: int, share: float
) -> Table:
    chosen = [
        one for one in found if (one.largest_angle, one.beams, one.share) == (angle, beams, share)
    ]
    return Table(
        title=f"{angle:g}°, {beams} beams, {100.0 * share:.0f} %, "
        f"{counted(chosen[0].profiles, 'profile')}",
        columns=(
            "way",
            "RMSE",
            "at the top",
            "extinction RMSE (km⁻¹)",
            "negative",
            "monotone",
            "RMSE < 0.5",
            "data share",
            "freedom",
        ),
        rows=tuple(
            (
                one.way,
                with_error(one.rmse),
                with_error(one.top_bias, sign=True),
                with_error(scaled(one.extinction_rmse, _PER_KM)),
                percent(one.negative),
                percent(one.monotone),
                percent(one.close.value),
                _NONE if one.data_share is None else f"{one.data_share:.2f}",
                _NONE if one.freedom is None else f"{one.freedom:.2f}",
            )
            for one in chosen
        ),
        note=f"{_ERRORS} At the top: mean error there. Negative: share of optical depths; "
        "monotone: share of profiles that nowhere decrease; data share and degrees of freedom "
        f"of an altitude: medians. {scores.TWO_ANGLE_ALONE}: of a normal scatter of 10 %.",
    )


def _prior_table(found: MultiAngle) -> Table:
    return Table(
        title="mld_prior at 15°, 6 beams, 25 %, with a multiple of the truth as prior",
        columns=("prior / truth", "prior alone", "RMSE", "data share"),
        rows=tuple(
            (f"{one.factor:g}", f"{one.alone:.2f}", with_error(one.rmse), f"{one.data_share:.2f}")
            for one in found.priors
        ),
        note="With the truth as prior, what is left is the share of the noise.",
    )


def _correlation_table(found: MultiAngle) -> Table:
    return Table(
        title="Layers that scatter alike: 15°, 6 beams, 14.7 %",
        columns=("correlation", "way", "RMSE", "RMSE < 0.5"),
        rows=tuple(
            (f"{one.correlation:g}", one.way, with_error(one.rmse), percent(one.close.value))
            for one in found.correlations
        ),
        note="Correlation of the scatter of neighbouring layers. RMSE < 0.5: share of profiles.",
    )


# Outliers, random scenes ----------------------------------------------------------------------


def _outliers(found: Sequence[OutlierScore]) -> Part:
    ways = list(dict.fromkeys(one.way for one in found))
    clean = {
        one.way.split(",")[0]: one
        for one in found
        if one.outliers == 0.0 and one.way.endswith("plain")
    }
    rows = []
    for way in ways:
        for one in (one for one in found if one.way == way):
            base = clean[way.split(",")[0]]
            rows.append(
                (
                    f"{way}, {100.0 * one.outliers:.0f} %",
                    with_error(one.low_rmse),
                    f"{one.low_rmse.value / base.low_rmse.value:.2f}",
                    with_error(one.rmse),
                    f"{one.rmse.value / base.rmse.value:.2f}",
                    *_shares(one.coverage),
                    percent(one.flagged),
                    percent(one.ran),
                )
            )
    table = Table(
        title="Optical depth with outliers",
        columns=(
            "way and share",
            "RMSE below 2 km",
            "times clean",
            "RMSE",
            "times clean",
            "within 1",
            "within 1.96",
            "flagged",
            "robust passes",
        ),
        rows=tuple(rows),
        note=f"{_ERRORS} Clean: the plain method without outliers, of other profiles. Flagged: "
        "share of values with the flag of outliers. Robust passes: share of blocks that ran them.",
    )
    return Part(
        title="Outliers",
        text="Clear air with a signal over noise of 3000; samples drawn at random are brighter by "
        "0.3 to 1 in the logarithm. Robust is the default.",
        tables=(table,),
    )


def _safety(found: Sequence[SafetyScore]) -> Part:
    rows = tuple(
        (
            f"{one.air}, {one.way}, {one.quantity}",
            f"{one.values:,}",
            *(
                _rare(share)
                for share in (one.random_only, one.false, one.false_ok, one.false_ok_profiles)
            ),
            percent(one.within.value),
            percent(one.flagged),
            percent(one.needless),
        )
        for one in found
    )
    table = Table(
        title=f"Values off by more than {scores.FALSE:g} stated errors",
        columns=(
            "way",
            "values",
            "random error alone",
            "with gradient bound",
            "and without a flag",
            "profiles with one",
            "within 1.96",
            "flagged",
            "needlessly",
        ),
        rows=rows,
        note="In brackets: Monte Carlo standard error, of scenes. Flagged: no_residual, gradient, "
        "undersmoothed, high_correlation or poor_stratification, which doubt the stated error; "
        "needlessly: off by less than 2.5. Within 1.96: of values without a flag. Extinction "
        "that is withheld does not count.",
    )
    return Part(
        title="False and not flagged",
        text=f"{found[0].scenes:,} scenes ({found[-1].scenes:,} of calm air) of which nothing is "
        "as assumed, 8 profiles each with its own truth: 3 to 20 beams on one side to 15-75°, "
        "clear air or a cloud, scatter up to 40 % (of calm air drawn by its logarithm, from "
        "0.5 %) with "
        "a correlation of 0 to 0.95, signal over noise 10 to 1e5; half with up to 10 % outliers; "
        "three in five with a horizontal gradient of up to 10 % per km, twice what the retrieval "
        "allows for by default; one in seven with extinction that varies along the paths. A "
        "one-sided scan does not see the gradient: without its bound, random errors alone would "
        "say far too little.",
        tables=(table,),
        details=tuple(_flag_table(one) for one in found),
    )


def _flag_table(found: SafetyScore) -> Table:
    return Table(
        title=f"Flags of {found.air}, {found.way}, {found.quantity}",
        columns=("flag", "share of values", "false of these"),
        rows=tuple(
            (one.flag, percent(one.values), _NONE if one.false is None else _rare(one.false))
            for one in found.flags
        ),
        note="False: off by more than 4 of random error and gradient bound together.",
    )


def _rare(share: MonteCarloFigure) -> str:
    return f"{with_error(scaled(share, 100.0))} %"


# Time -----------------------------------------------------------------------------------------


def _times(found: MultiAngleThroughput) -> Part:
    batches = sorted({cost.batch for cost in found.costs})
    return Part(
        title="CPU time per profile",
        text=f"Clear air, {found.angles} angles, {found.altitudes} altitudes, float64, one "
        "thread, least CPU time of interleaved repeats. make_beams, regress and vertical.smooth "
        "are steps; the others are whole calls of solve, with all errors, residuals and flags. "
        "Plain: without the robust passes, for which a single residual calls that is too "
        "large for chance, and which cost more than all else. The peers give values without flags, "
        f"lstsq with standard errors. {READ} is a vectorised maximum of the signals in the same "
        "run.",
        charts=(_time_ladder(found, batches),),
        tables=tuple(_time_table(found, batch) for batch in batches),
    )


def _time_ladder(found: MultiAngleThroughput, batches: Sequence[int]) -> Ladder:
    steps = list(dict.fromkeys(cost.step for cost in found.costs))
    spent = {(cost.batch, cost.step): cost.nanoseconds / 1e3 for cost in found.costs}
    return Ladder(
        name="multiangle-time",
        title=f"CPU time per profile of {found.angles} angles and {found.altitudes} altitudes",
        caption="By the number of profiles that a call is given.",
        x_label="CPU time per profile (µs)",
        rows=tuple(steps),
        series=tuple(
            (counted(batch, "profile"), tuple(spent.get((batch, step)) for step in steps))
            for batch in batches
        ),
    )


def _time_table(found: MultiAngleThroughput, batch: int) -> Table:
    costs = [cost for cost in found.costs if cost.batch == batch]
    whole = next(cost.nanoseconds for cost in costs if cost.step == cases.JOINT)
    samples = found.angles * found.altitudes
    return Table(
        title=f"Calls of {counted(batch, 'profile')}",
        columns=(
            "step",
            "whose",
            "profiles",
            "µs each",
            "ns a sample",
            "ns an altitude",
            "reads",
            "times joint",
        ),
        rows=tuple(
            (
                cost.step,
                _whose(cost),
                f"{cost.profiles:,}",
                f"{cost.nanoseconds / 1e3:,.2f}",
                f"{cost.nanoseconds / samples:,.2f}",
                f"{cost.nanoseconds / found.altitudes:,.1f}",
                f"{cost.reads:,.1f}",
                f"{cost.nanoseconds / whole:,.2f}",
            )
            for cost in costs
        ),
        note=f"Reads: multiples of {READ}. Profiles: of one call, fewer where it is slow.",
    )


def _whose(cost: StepCost) -> str:
    if cost.step in {READ, INPUTS}:
        return "floor"
    return "ours" if cost.ours else "peer"


# Numbers --------------------------------------------------------------------------------------


def scaled(figure: MonteCarloFigure, factor: float) -> MonteCarloFigure:
    """Return a figure in another unit."""
    return MonteCarloFigure(factor * figure.value, factor * figure.error)


def with_error(figure: MonteCarloFigure, *, sign: bool = False) -> str:
    """Return a figure with its error in the last digits."""
    plus = "+" if sign else ""
    if not figure.error > 0.0:
        return f"{figure.value:{plus}.3g}"
    digits = max(-math.floor(math.log10(figure.error)), 0)
    last = figure.error * 10**digits
    return f"{figure.value:{plus}.{digits}f}({last:.0f})"
