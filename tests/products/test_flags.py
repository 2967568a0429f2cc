"""Quality bits: distinct, documented, carried by files unchanged, and each raised by some scene."""

from __future__ import annotations

import ast
from pathlib import Path

import netCDF4
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context

from lidarops.flags import Quality, Severity
from lidarops.kinds import kinds
from lidarops.netcdf.variables import layout_of, summarize_flags
from lidarops.netcdf.write import write_product
from lidarops.retrieve.multiangle import labeled

BITS = list(Quality)

SCENES = {
    Quality.INPUT_MISSING: "test_cubic_and_tail::test_variance_that_is_not_finite_is_missing",
    Quality.SATURATED: "test_labeled_homogeneous::"
    "test_bad_bins_are_excluded_and_their_bits_carried",
    Quality.PILE_UP: "test_labeled_homogeneous::test_bad_bins_are_excluded_and_their_bits_carried",
    Quality.INCOMPLETE_OVERLAP: "test_labeled_homogeneous::"
    "test_bad_bins_are_excluded_and_their_bits_carried",
    Quality.TOO_FEW_BINS: "test_path_fit::test_few_bins",
    Quality.NO_SIGNAL: "test_path_fit::test_constant_profile_has_no_signal",
    Quality.LOW_SIGNAL: "test_cubic_and_tail::test_lost_roots_are_flagged",
    Quality.POORLY_DETERMINED: "test_path_fit::test_single_weak_shot_of_counts_is_flagged",
    Quality.NEGATIVE_AMPLITUDE: "test_path_fit::test_inverted_profile_has_negative_amplitude",
    Quality.AT_BOUND: "test_path_fit::test_extinction_stays_within_given_bounds_and_is_flagged",
    Quality.POOR_FIT: "test_path_fit::test_wrong_noise_variance_is_flagged",
    Quality.NOT_HOMOGENEOUS: "test_path_fit::"
    "test_backscatter_that_varies_along_the_path_is_flagged",
    Quality.OUTLIER: "test_path_fit::test_cloud_and_outlier_are_flagged",
    Quality.BACKGROUND_UNCERTAIN: "test_labeled_elastic::"
    "test_aerosol_in_the_far_range_makes_the_background_uncertain",
    Quality.NO_GLUING: "test_labeled_gluing::test_no_gluing_where_no_range_is_linear_in_both",
    Quality.CLOUD: "test_labeled_elastic::"
    "test_a_cloud_below_the_reference_is_flagged_with_all_bins_below_it",
    Quality.NO_REFERENCE: "test_labeled_elastic::test_an_opaque_cloud_leaves_no_reference",
    Quality.UNSTABLE_INVERSION: "test_labeled_elastic::"
    "test_an_inversion_away_from_the_reference_stops_where_it_is_unstable",
    Quality.NO_LEVERAGE: "test_labeled_multiangle::"
    "test_incomplete_cycles_are_used_as_far_as_possible",
    Quality.POOR_STRATIFICATION: "test_labeled_multiangle::"
    "test_extinction_stays_withheld_if_single_altitudes_replace_joint",
    Quality.EXTRAPOLATED: "test_labeled_multiangle::"
    "test_every_missing_value_is_explained_whatever_the_method",
    Quality.ONE_SIDED: "test_labeled_multiangle::"
    "test_an_angle_to_one_side_is_flagged_and_has_a_systematic_error",
    Quality.HIGH_CORRELATION: "test_labeled_multiangle::"
    "test_single_altitudes_stay_valid_if_shot_energy_jitters",
    Quality.NOT_LEVEL: "test_archives::test_the_campaign_knows_the_pointing_better_than_the_header",
}
"""The test of a scene that raises the bit; the bit stands in it by name."""

BY_FIELD = {
    Quality.PRIOR_DOMINATED: (
        "prior_dominated",
        "test_mld::test_published_claim_is_not_reproduced_at_15_degrees",
    ),
    Quality.INTERPOLATED: (
        "interpolated",
        "test_optical_depth::test_invalid_profiles_do_not_affect_others",
    ),
    Quality.LOW_LEVERAGE: (
        "low_leverage",
        "test_optical_depth::test_tiny_leverage_is_flagged_and_has_a_correct_error",
    ),
    Quality.NO_RESIDUAL: (
        "no_residual",
        "test_smooth_profile::test_noise_estimated_from_few_residuals_widens_the_errors",
    ),
    Quality.UNDERSMOOTHED: (
        "undersmoothed",
        "test_smooth_profile::test_profile_with_too_much_structure_for_smoothing_is_flagged",
    ),
    Quality.HORIZONTAL_GRADIENT: ("gradient", "test_kano_hamilton"),
}
"""As above, where the bit is a boolean of a result that `labeled_multiangle` turns into it."""

GUARDS = {Quality.NO_REAL_SOLUTION}
"""Raised only where arithmetic fails; no scene is known that does it."""


def source(repository: Path, scene: str) -> str:
    module, _, name = scene.partition("::")
    (path,) = (repository / "tests").rglob(f"{module}.py")
    text = path.read_text(encoding="utf-8")
    if not name:
        return text
    functions = [
        node
        for node in ast.parse(text).body
        if isinstance(node, ast.FunctionDef) and node.name == name
    ]
    assert functions, f"{scene} is no more"
    lines = text.splitlines()
    first = min(node.lineno for node in (functions[0], *functions[0].decorator_list))
    return "\n".join(lines[first - 1 : functions[0].end_lineno])


def test_bits_are_distinct_powers_of_two_of_one_type():
    values = [int(bit) for bit in BITS]
    assert values == [1 << number for number in range(len(values))]
    assert max(values) <= np.iinfo(np.int32).max
    assert {layout.row("quality_flag").dtype for layout in map(layout_of, kinds())} == {"i4"}


@pytest.mark.parametrize("bit", BITS, ids=lambda bit: bit.name)
def test_every_bit_is_documented_in_some_kind_and_raised_by_some_scene(
    bit: Quality, repository: Path
):
    assert len(bit.description.split()) > 3
    assert bit.severity in Severity
    assert any(bit & (layout.row("quality_flag").flags or 0) for layout in map(layout_of, kinds()))
    if bit in SCENES:
        assert f"Quality.{bit.name}" in source(repository, SCENES[bit])
    elif bit in BY_FIELD:
        field, scene = BY_FIELD[bit]
        assert f".{field}" in source(repository, scene)
        written = Path(str(labeled.__file__)).read_text(encoding="utf-8")
        assert f'"{field}": Quality.{bit.name}' in written
    else:
        assert bit in GUARDS, "name a scene that raises it"


@given(bits=st.sets(st.sampled_from(BITS)))
def test_usable_is_the_worst_of_any_set_of_bits(bits: set[Quality]):
    flags = np.array([sum(bits)], np.int32)
    assert summarize_flags(flags)[0] == max((bit.severity for bit in bits), default=0)


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
@pytest.mark.parametrize("kind", list(MAKERS))
def test_any_bits_come_back_from_a_file_by_mask_and_meaning(
    kind: str, data: st.DataObject, tmp_path: Path
):
    results = MAKERS[kind](profiles=2).fillna(1.0)
    allowed = list(layout_of(kind).row("quality_flag").flags or Quality(0))
    sets = data.draw(st.lists(st.sets(st.sampled_from(allowed)), min_size=1, max_size=8))
    values = np.array([sum(each) for each in sets], np.int32)
    shape = results["quality_flag"].shape
    results["quality_flag"] = (results["quality_flag"].dims, np.resize(values, shape))
    path = tmp_path / "flags.nc"
    write_product(build_product(results, context(kind)), path)
    with netCDF4.Dataset(path) as file:
        variable = file["quality_flag"]
        stored = variable[...].ravel()
        names = dict(zip(variable.flag_meanings.split(), variable.flag_masks, strict=True))
        assert variable.flag_masks.dtype == variable.dtype
        for index in range(len(sets)):
            if index < stored.size:
                read = {name for name, mask in names.items() if stored[index] & mask}
                assert read == {str(bit.name).lower() for bit in sets[index]}
