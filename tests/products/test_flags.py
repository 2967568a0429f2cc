"""Quality bits: at their published places, documented, carried by files, raised by some scene."""

from __future__ import annotations

import ast
from pathlib import Path

import netCDF4
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.cases import each
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context

from lidarops.flags import FIRST_OWN, PLACES, FlagBit, Flags, Quality, Severity
from lidarops.kinds import flags_of
from lidarops.netcdf.variables import Row, layout_of, summarize_flags
from lidarops.netcdf.write import write_product

SHARED = {
    "input_missing": 0,
    "saturated": 1,
    "pile_up": 2,
    "incomplete_overlap": 3,
    "too_few_bins": 4,
    "no_signal": 5,
    "low_signal": 6,
    "single_record": 7,
    "negative_amplitude": 8,
    "contradicted": 9,
    "disagrees": 10,
    "not_homogeneous": 11,
    "outlier": 12,
    "no_real_solution": 13,
    "low_signal_to_noise": 14,
    "background_uncertain": 15,
    "no_gluing": 16,
}
OWN = {
    "signal": {},
    "homogeneous": {
        "poorly_determined": 17,
        "poor_fit": 18,
        "at_bound": 19,
        "not_level": 20,
        "noise_uncertain": 21,
    },
    "elastic": {
        "cloud": 17,
        "no_reference": 18,
        "unstable_inversion": 19,
        "negative_backscatter": 20,
        "unknown_overlap": 21,
        "partly_cloudy": 22,
        "standard_air": 23,
    },
    "raman": {
        "no_reference": 17,
        "weak_signal": 18,
        "no_lidar_ratio": 19,
        "negative_extinction": 20,
        "partly_cloudy": 21,
        "cloud": 22,
        "doubtful_water_vapour": 23,
        "common_overlap": 24,
        "standard_air": 25,
    },
    "multiangle": {
        "negative_optical_depth": 19,
        "no_leverage": 20,
        "poor_stratification": 21,
        "prior_dominated": 22,
        "extrapolated": 23,
        "interpolated": 24,
        "no_residual": 27,
    },
    "visibility": {
        "poorly_determined": 17,
        "poor_fit": 18,
        "prior_dominated": 22,
        "low_leverage": 26,
    },
}
"""Published places. Add new bits; never change or delete an entry, nor give its place to another
bit: that needs a new version of the layout."""
VERSION = {
    "signal": 2,
    "homogeneous": 2,
    "elastic": 3,
    "raman": 1,
    "multiangle": 4,
    "visibility": 2,
}
RETIRED = {"multiangle": {25, 26, 28, 29, 30}}
"""Places of bits of former versions: one_sided, low_leverage, undersmoothed, high_correlation and
horizontal_gradient."""

LEFT = {
    "shared": 0,
    "signal": 14,
    "homogeneous": 9,
    "elastic": 7,
    "raman": 5,
    "multiangle": 2,
    "visibility": 10,
}
"""Places left for new bits."""

SCENES = {
    "Quality.INPUT_MISSING": "test_cubic_and_tail::test_variance_that_is_not_finite_is_missing",
    "Quality.SATURATED": "test_labeled_homogeneous::"
    "test_bad_bins_are_excluded_and_their_bits_carried",
    "Quality.PILE_UP": "test_labeled_homogeneous::"
    "test_bad_bins_are_excluded_and_their_bits_carried",
    "Quality.INCOMPLETE_OVERLAP": "test_labeled_homogeneous::"
    "test_bad_bins_are_excluded_and_their_bits_carried",
    "Quality.TOO_FEW_BINS": "test_path_fit::test_few_bins",
    "Quality.NO_SIGNAL": "test_path_fit::test_constant_profile_has_no_signal",
    "Quality.LOW_SIGNAL": "test_cubic_and_tail::test_lost_roots_are_flagged",
    "HomogeneousQuality.POORLY_DETERMINED": "test_homogeneous_stress::test_s12_single_weak_shot",
    "Quality.NEGATIVE_AMPLITUDE": "test_homogeneous_stress::test_s16_inverted_signal",
    "HomogeneousQuality.AT_BOUND": "test_path_fit::test_dead_time_and_saturation_are_flagged",
    "HomogeneousQuality.POOR_FIT": "test_path_fit::"
    "test_noise_beyond_the_stated_variance_is_flagged",
    "Quality.NOT_HOMOGENEOUS": "test_path_fit::"
    "test_backscatter_that_varies_along_the_path_is_flagged",
    "Quality.OUTLIER": "test_path_fit::test_cloud_and_outlier_are_flagged",
    "Quality.LOW_SIGNAL_TO_NOISE": "test_signal_to_noise::"
    "test_values_below_their_error_are_used_with_care",
    "Quality.BACKGROUND_UNCERTAIN": "test_labeled_elastic::"
    "test_aerosol_in_the_far_range_makes_the_background_uncertain",
    "Quality.CONTRADICTED": "test_scans::"
    "test_values_of_a_channel_that_others_contradict_are_not_good",
    "Quality.DISAGREES": "test_scans::"
    "test_two_channels_that_disagree_are_both_to_be_used_with_care",
    "Quality.SINGLE_RECORD": "test_labeled_gluing::test_each_record_alone_has_the_bit",
    "Quality.NO_GLUING": "test_labeled_gluing::test_no_gluing_where_neither_record_shows_light",
    "ElasticQuality.CLOUD": "test_labeled_elastic::"
    "test_a_cloud_below_the_reference_is_flagged_with_all_bins_below_it",
    "ElasticQuality.NO_REFERENCE": "test_labeled_elastic::test_an_opaque_cloud_leaves_no_reference",
    "ElasticQuality.UNSTABLE_INVERSION": "test_labeled_elastic::"
    "test_an_inversion_away_from_the_reference_stops_where_it_is_unstable",
    "ElasticQuality.NEGATIVE_BACKSCATTER": "test_labeled_elastic::"
    "test_an_overlap_that_is_not_full_where_stated_is_found_by_negative_backscatter",
    "ElasticQuality.UNKNOWN_OVERLAP": "test_labeled_elastic::"
    "test_an_overlap_that_is_not_stated_is_no_cloud",
    "ElasticQuality.PARTLY_CLOUDY": "test_partly_cloudy::"
    "test_a_cirrus_that_ends_before_the_middle_is_stated",
    "ElasticQuality.STANDARD_AIR": "test_atmosphere::"
    "test_nights_without_source_are_told_and_flagged",
    "RamanQuality.STANDARD_AIR": "test_atmosphere::test_nights_without_source_are_told_and_flagged",
    "RamanQuality.NO_REFERENCE": "test_raman_retrieval::"
    "test_particles_everywhere_leave_no_reference",
    "RamanQuality.WEAK_SIGNAL": "test_raman_retrieval::"
    "test_profiles_without_raman_signal_have_no_values",
    "RamanQuality.NO_LIDAR_RATIO": "test_raman_retrieval::"
    "test_profiles_without_raman_signal_have_no_values",
    "RamanQuality.NEGATIVE_EXTINCTION": "test_raman_retrieval::"
    "test_an_overlap_that_is_not_full_where_stated_is_found",
    "RamanQuality.PARTLY_CLOUDY": "test_raman_clouds::"
    "test_a_cirrus_in_some_of_the_profiles_is_stated",
    "RamanQuality.CLOUD": "test_raman_clouds::test_a_cloud_in_all_profiles_is_no_partial_one",
    "RamanQuality.DOUBTFUL_WATER_VAPOUR": "test_raman_channels::"
    "test_a_broken_channel_of_water_vapour_concerns_water_vapour_alone",
    "RamanQuality.COMMON_OVERLAP": "test_raman_channels::"
    "test_bits_of_one_quantity_are_none_of_another",
    "MultiAngleQuality.NEGATIVE_OPTICAL_DEPTH": "test_labeled_multiangle::"
    "test_an_optical_depth_below_zero_or_falling_is_flagged",
    "MultiAngleQuality.NO_LEVERAGE": "test_labeled_multiangle::"
    "test_incomplete_cycles_are_used_as_far_as_possible",
    "MultiAngleQuality.POOR_STRATIFICATION": "test_labeled_multiangle::"
    "test_extinction_that_varies_along_the_paths_is_withheld",
    "MultiAngleQuality.EXTRAPOLATED": "test_labeled_multiangle::"
    "test_every_missing_value_is_explained_whatever_the_method",
    "HomogeneousQuality.NOT_LEVEL": "test_archives::"
    "test_the_campaign_knows_the_pointing_better_than_the_header",
    "HomogeneousQuality.NOISE_UNCERTAIN": "test_homogeneous_limits::"
    "test_errors_from_estimated_noise_are_widened_as_the_page_tells",
    "NetworkQuality.PRIOR_DOMINATED": "test_labeled_network::test_a_missing_beam_gives_a_reason",
    "NetworkQuality.POORLY_DETERMINED": "test_network_extremes",
    "NetworkQuality.POOR_FIT": "test_network_outlying_bins",
    "NetworkQuality.LOW_LEVERAGE": "test_network_noise",
    "MultiAngleQuality.PRIOR_DOMINATED": "test_mld::"
    "test_published_claim_is_not_reproduced_at_15_degrees",
    "MultiAngleQuality.INTERPOLATED": "test_optical_depth::"
    "test_invalid_profiles_do_not_affect_others",
    "MultiAngleQuality.NO_RESIDUAL": "test_optical_depth::test_two_beams_have_no_residual",
}
"""The test of a scene that raises the bit; the bit stands in it by name."""

GUARDS = {"Quality.NO_REAL_SOLUTION"}
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


def bit_id(bit: FlagBit) -> str:
    return f"{type(bit).__name__}.{bit.name}"


BITS = list({bit_id(bit): bit for kind in OWN for bit in flags_of(kind)}.values())


@each("kind", OWN)
def test_published_places_do_not_change(kind: str):
    flags = flags_of(kind)
    places = {bit.word: int(bit).bit_length() - 1 for bit in flags}
    assert flags.layout == f"{kind} {VERSION[kind]}"
    assert not RETIRED.get(kind, set()) & set(places.values())
    assert {word: SHARED[word] for word in places if word in SHARED} | OWN[kind] == places
    assert {int(bit) for bit in flags} == {1 << place for place in places.values()}
    assert sorted({*places.values()}) == list(places.values())
    assert layout_of(kind).rows["quality_flag"].dtype == "i4"
    assert sum(flags) <= np.iinfo(np.int32).max


def test_shared_places_are_the_same_for_all_and_left_free_by_the_own_bits():
    assert {bit.word: int(bit).bit_length() - 1 for bit in Quality} == SHARED
    assert all(place < FIRST_OWN for place in SHARED.values())
    assert all(FIRST_OWN <= place < PLACES for own in OWN.values() for place in own.values())


def test_there_is_room_for_new_bits():
    left = {
        kind: PLACES - FIRST_OWN - len(own) - len(RETIRED.get(kind, ()))
        for kind, own in OWN.items()
    }
    assert left | {"shared": FIRST_OWN - len(SHARED)} == LEFT


class Twins(FlagBit):
    """Own bits of a kind in another package."""

    ODD = FIRST_OWN, Severity.CARE, "a test of the other package failed"
    HIGH = PLACES, Severity.CARE, "beyond the type of the variable"
    LOW = 7, Severity.CARE, "among the shared bits"
    OUTLIER = FIRST_OWN + 1, Severity.REJECT, "has the name of a shared bit"


@each(
    "bits",
    [
        (Twins.ODD, Twins.ODD),
        (Twins.ODD, Quality.OUTLIER),
        (Twins.HIGH,),
        (Twins.LOW,),
        (Quality.OUTLIER, Twins.OUTLIER),
    ],
)
def test_flags_that_would_be_ambiguous_are_refused(bits: tuple[FlagBit, ...]):
    with pytest.raises(ValueError, match="flags of other: names and places"):
        Flags("other", 1, bits)


def test_a_kind_of_another_package_states_its_bits_by_itself():
    flags = Flags("other", 3, (Quality.SATURATED, Quality.OUTLIER, Twins.ODD))
    assert flags.layout == "other 3"
    assert flags.rejecting == Quality.SATURATED
    assert flags.raised(int(Quality.OUTLIER | Twins.ODD) | 1) == (Quality.OUTLIER, Twins.ODD)
    assert flags.named("ODD") is flags.named("odd") is Twins.ODD
    assert flags.named("input_missing") is None
    assert (Twins.ODD.word, Twins.ODD.severity) == ("odd", Severity.CARE)


@pytest.mark.parametrize("bit", BITS, ids=bit_id)
def test_every_bit_is_documented_and_raised_by_some_scene(bit: FlagBit, repository: Path):
    name = bit_id(bit)
    assert len(bit.description.split()) > 3
    assert bit.severity in Severity
    if name in SCENES:
        assert name in source(repository, SCENES[name])
    else:
        assert name in GUARDS, "name a scene that raises it"


@given(data=st.data(), kind=st.sampled_from(list(OWN)))
def test_usable_is_the_worst_of_any_set_of_bits(data: st.DataObject, kind: str):
    bits = data.draw(st.sets(st.sampled_from(list(flags_of(kind)))))
    values = np.array([sum(bits)], np.int32)
    worst = max((bit.severity for bit in bits), default=0)
    assert summarize_flags(values, flags_of(kind))[0] == worst


@pytest.mark.parametrize("kind", list(MAKERS))
def test_any_bits_come_back_from_a_file_by_mask_and_meaning(kind: str, tmp_path: Path):
    for row in layout_of(kind).judges:
        check_bits(kind, row, tmp_path / "flags.nc")


def check_bits(kind: str, row: Row, path: Path) -> None:
    bits = set(row.flags or ())
    # No bit, all of them, each alone, and each left out.
    sets = [set(), bits, *({bit} for bit in bits), *(bits - {bit} for bit in bits)]
    results = MAKERS[kind](profiles=len(sets)).fillna(1.0)
    values = np.array([sum(each) for each in sets], np.int32)
    shape = results[row.name].shape
    results[row.name] = (results[row.name].dims, np.resize(values, shape))
    write_product(build_product(results, context(kind)), path)
    with netCDF4.Dataset(path) as file:
        variable = file[row.name]
        stored = variable[...].ravel()
        names = dict(zip(variable.flag_meanings.split(), variable.flag_masks, strict=True))
        assert variable.flag_masks.dtype == variable.dtype
        assert variable.lidarops_flag_layout == f"{kind} {VERSION[kind]}"
        for value, each in zip(stored[: len(sets)], sets, strict=True):
            read = {name for name, mask in names.items() if value & mask}
            assert read == {bit.word for bit in each}
