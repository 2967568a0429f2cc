"""The first campaign file of a folder: what headers state, and the questions they leave."""

from __future__ import annotations

import json
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml
from support.archives.raw_archives import content, write
from typer.testing import CliRunner

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.catalog.draft import drafted_instruments
from lidarops.catalog.folder import read_folder
from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.records import Granule, Role, Status
from lidarops.run.archive import bring_up_to_date


def drafted(folder: Path, campaign: Path) -> tuple[Campaign, str]:
    shown = CliRunner().invoke(app, ["init", "--headers-only", str(folder), str(campaign)])
    assert shown.exit_code == 0, shown.output
    return load_campaign(campaign), campaign.read_text(encoding="utf-8")


def granules(campaign: Campaign) -> list[Granule]:
    store = Store(campaign.catalog_url, campaign.name)
    summary = scan_archive(campaign, store)
    assert summary.idle_patterns == ()
    found = sorted(store.granules(), key=lambda granule: granule.path)
    store.close()
    return found


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Raw files of two sites in folders of days, with dark files, a damaged file and a text."""
    raw = tmp_path / "raw"
    hill = {"site": "Hill", "position": (47.8, 11.0), "zenith_angle": 0.0}
    for day in range(2):
        for number in range(3):
            minutes = 1440.0 * day + 5.0 * number
            write(raw / f"day{day}/h26{number}", content(minutes, seed=number))
            write(raw / f"day{day}/v26{number}", content(minutes, seed=number, **hill))
    write(raw / "dark/h26", content(20.0))
    write(raw / "day1/h269", content(30.0)[:-500])
    write(raw / "notes.txt", b"Measured with the new telescope, in the evening, above the harbour.")
    return raw


def test_a_folder_that_is_absent_is_wrong_use_with_its_own_remedy(tmp_path: Path) -> None:
    campaign = tmp_path / "campaign.yaml"
    shown = CliRunner().invoke(app, ["init", str(tmp_path / "absent"), str(campaign)])
    assert shown.exit_code == 2
    assert "give the folder of the raw files" in " ".join(shown.output.split())
    assert "LIDAROPS_ARCHIVE" not in shown.output
    assert not campaign.exists()


def test_a_second_campaign_beside_the_first_has_its_own_output(tmp_path: Path) -> None:
    write(tmp_path / "raw/h26", content())
    outputs = [
        Path(drafted(tmp_path / "raw", tmp_path / name)[0].output).name
        for name in ("first.yaml", "second.yaml")
    ]
    assert outputs == ["out", "out-second"]
    assert "# 1 file, " in (tmp_path / "first.yaml").read_text(encoding="utf-8")
    options = ["init", str(tmp_path / "raw"), str(tmp_path / "first.yaml"), "--force"]
    assert CliRunner().invoke(app, options).exit_code == 0
    assert Path(load_campaign(tmp_path / "first.yaml").output).name == "out"


@pytest.mark.parametrize(
    ("written", "source"),
    [(-90.0, "zenith angle -90 taken as vertical"), (0.0, "headers state 0")],
)
def test_an_angle_that_stands_for_another_is_stated_as_written(
    tmp_path: Path, written: float, source: str
) -> None:
    write(tmp_path / "raw/h26", content(zenith_angle=written))
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (line,) = (line for line in text.splitlines() if "zenith_angle: 0 " in line)
    assert line.endswith(f"# ? degree, {source}")
    assert campaign.instruments["coast-lidar"].facts[0].zenith_angle == 0.0


def test_every_good_file_gets_its_instrument_and_role(raw: Path, tmp_path: Path) -> None:
    campaign, text = drafted(raw, tmp_path / "campaign.yaml")
    known = granules(campaign)
    assert {g.path: (g.instrument, g.role) for g in known if g.status is Status.GOOD} == {
        **{f"day{d}/h26{n}": ("coast-lidar", Role.SIGNAL) for d in (0, 1) for n in range(3)},
        **{f"day{d}/v26{n}": ("hill-lidar", Role.SIGNAL) for d in (0, 1) for n in range(3)},
        "dark/h26": ("coast-lidar", Role.DARK),
    }
    assert all(granule.contradictions == () for granule in known)
    assert [g.path for g in known if g.status is Status.REFUSED] == ["day1/h269"]
    assert "day1/h269" in text
    assert "notes.txt" in text


def test_products_follow_from_the_pointing(raw: Path, tmp_path: Path) -> None:
    campaign, text = drafted(raw, tmp_path / "campaign.yaml")
    level, steep = (campaign.instruments[f"{site}-lidar"] for site in ("coast", "hill"))
    assert set(level.products.requested) == {"signal", "homogeneous"}
    assert set(steep.products.requested) == {"signal", "elastic"}
    assert steep.products.requested["elastic"].channels == ["glued_532o"]
    assert "pairs that can be joined: glued_532o" in text
    assert level.facts[0].zenith_angle == 90.0
    # A glued channel needs it.
    assert steep.facts[0].channels["photon_532o"].dead_time == "estimate"
    assert level.facts[0].channels["photon_532o"].dead_time is None


def test_a_scan_keeps_the_pointing_of_its_headers(tmp_path: Path) -> None:
    for number, angle in enumerate((0.0, 30.0, 60.0)):
        write(tmp_path / f"raw/h26{number}", content(number, zenith_angle=angle))
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (lidar,) = campaign.instruments.values()
    assert set(lidar.products.requested) == {"signal", "multiangle"}
    facts = lidar.facts[0].channels
    assert facts["photon_532o"].dead_time == "estimate"
    assert facts["analog_532o"].dead_time is None
    assert [granule.zenith_angle for granule in granules(campaign)] == [0.0, 30.0, 60.0]


@pytest.mark.parametrize(
    ("written", "pointing", "zenith", "azimuth"),
    [
        ((-15.0, -40.0, -90.0), "elevation", [75.0, 50.0, 0.0], [20.0, 20.0, 20.0]),
        ((-15.0, -40.0, -60.0), "elevation", [75.0, 50.0, 30.0], [20.0, 20.0, 20.0]),
        ((-60.0, -30.0, 0.0, 45.0), "zenith_angle", [60, 30, 0, 45], [200, 200, 20, 20]),
    ],
)
def test_a_scan_whose_headers_do_not_tell_what_its_angles_are_is_a_question(
    tmp_path: Path,
    written: tuple[float, ...],
    pointing: str,
    zenith: list[float],
    azimuth: list[float],
) -> None:
    """It is drafted as a scan: a zenith angle in the facts would flatten it."""
    for number, angle in enumerate(written):
        write(tmp_path / f"raw/h26{number}", content(number, zenith_angle=angle, azimuth=20.0))
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (lidar,) = campaign.instruments.values()
    assert lidar.facts[0].zenith_angle is None
    assert lidar.header_pointing == pointing
    (line,) = (line for line in text.splitlines() if "header_pointing" in line)
    assert "# ? elevation or zenith_angle" in line
    assert set(lidar.products.requested) == {"signal", "multiangle"}
    known = granules(campaign)
    assert [granule.zenith_angle for granule in known] == zenith
    assert [granule.azimuth for granule in known] == azimuth
    assert all("header_pointing" in " ".join(granule.notes) for granule in known)


def test_doubtful_angles_of_dark_files_alone_do_not_end_the_draft(tmp_path: Path) -> None:
    for number, angle in enumerate((-90.0, -90.0)):
        write(tmp_path / f"raw/h26{number}", content(number, zenith_angle=angle))
        dark = content(60 + number, zenith_angle=-15.0 - number)
        write(tmp_path / f"raw/dark/h26{number}", dark)
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (lidar,) = campaign.instruments.values()
    assert lidar.facts[0].zenith_angle == 0.0
    assert all(granule.status is Status.GOOD for granule in granules(campaign))


def test_a_single_doubtful_angle_among_others_is_refused(tmp_path: Path) -> None:
    """A zenith angle in the facts would hold for it too."""
    for number, angle in enumerate((-90.0, -90.0, -12.0, -90.0)):
        write(tmp_path / f"raw/h26{number}", content(number, zenith_angle=angle))
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert "# zenith_angle: 0  # ? degree, zenith angle -90 taken as vertical" in text
    assert "1 files state no sure pointing and are refused" in text
    known = granules(campaign)
    assert [g.zenith_angle for g in known if g.status is Status.GOOD] == [0.0] * 3
    (reason,) = (granule.reason for granule in known if granule.status is Status.REFUSED)
    assert "set header_pointing if it states no scan" in reason


def test_a_scan_with_a_folder_for_each_beam_keeps_all(tmp_path: Path) -> None:
    for number in range(6):
        data = content(number, zenith_angle=(0.0, 30.0, 60.0)[number % 3])
        write(tmp_path / f"raw/beam{number % 3}/h{number}", data)
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert len(granules(campaign)) == 6


def test_an_instrument_with_the_channels_of_a_scanning_one_gets_its_dead_times(
    tmp_path: Path,
) -> None:
    """As the same lidar, of which some files state another site."""
    for number, angle in enumerate((0.0, 30.0, 60.0)):
        write(tmp_path / f"raw/h26{number}", content(number, zenith_angle=angle))
    write(tmp_path / "raw/v26", content(90.0, site="Hill", zenith_angle=0.0))
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert set(campaign.instruments["hill-lidar"].products.requested) == {"signal", "elastic"}
    for lidar in campaign.instruments.values():
        assert lidar.facts[0].channels["photon_532o"].dead_time == "estimate"


def test_lidars_of_near_stations_are_shown_as_a_network(tmp_path: Path) -> None:
    places = {"west": (47.2, 11.3), "east": (47.2, 11.4), "far": (52.0, 11.3), "up": (47.2, 11.4)}
    for site, position in places.items():
        angle = 0.0 if site == "up" else 90.0
        data = content(site=site, position=position, zenith_angle=angle)
        write(tmp_path / f"raw/{site}/h0", data)
    _, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    _, _, comment = text.partition("# networks:\n")
    block = "".join(line[2:] + "\n" for line in comment.splitlines() if line.startswith("#  "))
    campaign = tmp_path / "with_network.yaml"
    campaign.write_text(f"{text}\nnetworks:\n{block}", encoding="utf-8")
    (network,) = load_campaign(campaign).networks.values()
    assert set(network.instruments) == {"west-lidar", "east-lidar"}
    assert network.requested["visibility"].channel == "photon_532o"


@pytest.mark.parametrize(
    ("header", "changed", "position"),
    [
        (b"0030.7 0046.4", b"0230.7 0046.4", None),
        (b"0030.7 0046.4", b"0095.0 0099.0", None),
        (b"0030.7 0046.4", b"0030.7 0146.4", (30.7, 146.4)),
        (b"0020 0030.7", b"9999 0030.7", (46.4, 30.7)),
        (b"Coast   ", b"K\xfcste:# ", (46.4, 30.7)),
        (b"Coast   ", b'C"\x85\x01a\\ ', (46.4, 30.7)),
        (b"0046.4 90 ", b"0046.4 -30", (46.4, 30.7)),
    ],
    ids=["nowhere", "no latitude", "swapped", "high", "umlaut", "control", "negative"],
)
def test_odd_headers_give_a_campaign_file_that_can_be_used(
    header: bytes, changed: bytes, position: tuple[float, float] | None, tmp_path: Path
) -> None:
    data = content()
    assert header in data
    for number in range(2):
        write(tmp_path / f"raw/h{number}", content(number).replace(header, changed))
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (station,) = campaign.stations.values()
    assert (station.latitude, station.longitude) == (position or (0.0, 0.0))
    assert [granule.status for granule in granules(campaign)] == [Status.GOOD] * 2


def test_one_damaged_position_does_not_count(tmp_path: Path) -> None:
    for number in range(4):
        data = content(number)
        damaged = data.replace(b"0030.7 0046.4", b"0987.6 0765.4") if number == 0 else data
        write(tmp_path / f"raw/h{number}", damaged)
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (station,) = campaign.stations.values()
    assert (station.latitude, station.longitude) == (46.4, 30.7)


def test_patterns_of_instruments_are_disjoint(tmp_path: Path) -> None:
    """The stem of one instrument begins with that of the other."""
    write(tmp_path / "raw/h261", content())
    write(tmp_path / "raw/hill26", content(site="Hill", position=(47.8, 11.0)))
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert {g.path: g.instrument for g in granules(campaign) if g.status is Status.GOOD} == {
        "h261": "coast-lidar",
        "hill26": "hill-lidar",
    }


def test_editors_find_the_schema(raw: Path, tmp_path: Path) -> None:
    _, text = drafted(raw, tmp_path / "new/campaign.yaml")
    first = text.splitlines()[0]
    schema = tmp_path / "new" / first.partition("$schema=")[2]
    assert first.startswith("# yaml-language-server: ")
    assert "instruments" in yaml.safe_load(schema.read_text(encoding="utf-8"))["properties"]


def test_a_campaign_file_is_not_overwritten(raw: Path, tmp_path: Path) -> None:
    campaign = tmp_path / "campaign.yaml"
    campaign.write_text("mine")
    shown = CliRunner().invoke(app, ["init", str(raw), str(campaign)])
    assert shown.exit_code == 2
    assert campaign.read_text() == "mine"


def test_a_folder_without_raw_files_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "raw/notes.txt", b"nothing was measured")
    shown = CliRunner().invoke(app, ["init", str(tmp_path / "raw"), str(tmp_path / "new.yaml")])
    assert shown.exit_code == 1
    assert "no raw file" in shown.output
    assert not (tmp_path / "new.yaml").exists()


@pytest.mark.parametrize("name", ["manaus", "manaus_raman", "pilar", "saopaulo", "savant", ""])
def test_files_of_real_archives_are_those_of_their_headers(
    name: str, data_root: Path, tmp_path: Path
) -> None:
    campaign, text = drafted(data_root / name, tmp_path / "campaign.yaml")
    known = granules(campaign)
    unused = [granule.reason for granule in known if granule.status is Status.REFUSED]
    assert all("not on the grid of its scan" in reason for reason in unused)
    assert all(granule.contradictions == () for granule in known)
    if name == "saopaulo":
        assert sum(granule.role is Role.DARK for granule in known) == 12
    if name == "manaus_raman":
        assert "nitrogen: {photon_355o: photon_387o}" in text
        assert "molecular_profile; copy them below the folder of this file first" in text


@pytest.mark.slow
def test_the_draft_of_a_real_scan_gives_usable_values(data_root: Path, tmp_path: Path) -> None:
    """Without dead time, `poor_stratification` rejects all its cycles."""
    _, text = drafted(data_root / "savant", tmp_path / "campaign.yaml")
    assert "channels: [photon_355p, photon_355s, analog_355p, analog_355s]" in text
    # One temp.dat is the copy of a record, the other one the only copy, of a background.
    assert "2018A18/temp.dat" in text
    assert "1 file, copies of the last record of the acquisition, left out:" in text
    options = ["--product", "multiangle", "--instrument", "u-c-vol-lidar", "--json"]
    shown = CliRunner().invoke(app, ["reprocess", str(tmp_path / "campaign.yaml"), *options])
    qualities = json.loads(shown.stdout)["quality"]
    (quality,) = (own for name, own in qualities.items() if "photon_355p" in name)
    assert quality["good"] + quality["care"] == 100
    # Of four lone records of low beams; one is blocked, so that analog values are usable.
    assert quality["reject"] == 200
    (quality,) = (own for name, own in qualities.items() if "analog_355s" in name)
    assert quality["good"] + quality["care"] == 100


@pytest.mark.parametrize(
    ("folder", "role"),
    [
        ("RS_20260301_0000", Role.SIGNAL),
        ("DC_20260301_0000", Role.DARK),
        ("darkcurrent", Role.DARK),
        ("DP_20260301_0000/+45", None),
        ("polcal/m45", None),
        ("telecover_north", None),
        ("TC-N", None),
        ("DP+45", None),
        ("Delta-45deg", None),
        ("pol-cal", None),
        ("20170928-DC", Role.DARK),
        ("bkg1", None),
        ("20260301/bg", None),
        ("0755bACKGROUND", None),
        # Words that are parts of other ones.
        ("adcp", Role.SIGNAL),
        ("midpoint", Role.SIGNAL),
        ("Darkhan", Role.SIGNAL),
        ("depol", Role.SIGNAL),
        ("2023-45", Role.SIGNAL),
    ],
)
def test_files_of_tests_and_calibrations_are_a_question_and_no_measurements(
    tmp_path: Path, folder: str, role: Role | None
) -> None:
    paths = {f"{folder}/h{number}": content(number, seed=number) for number in range(2)}
    usual = {f"evening/h{number}": content(60.0 + number, seed=number) for number in range(3)}
    for path, data in {**paths, **usual}.items():
        write(tmp_path / "raw" / path, data)
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    known = {granule.path: granule.role for granule in granules(campaign)}
    expected = dict.fromkeys(usual, Role.SIGNAL) | (dict.fromkeys(paths, role) if role else {})
    assert known == expected
    assert ("by path or counts, left out of `files`" in text) == (role is None)
    assert all(path in text for path in paths) or role is not None


def test_only_files_of_a_calibration_are_drafted_as_they_are(tmp_path: Path) -> None:
    write(tmp_path / "raw/calibration/h0", content(0.0))
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert [granule.path for granule in granules(campaign)] == ["calibration/h0"]
    assert "by path or counts, in `files`, as there are no others:" in text
    assert "left out" not in text


@pytest.mark.parametrize(
    ("folders", "left_out"),
    [(["N", "E", "S", "W"], True), (["day/north", "day/east", "day/south", "day/west"], True),
     (["N", "S"], False), (["a/north", "a/east", "b/south", "b/west"], False)],
)  # fmt: skip
def test_folders_of_four_sectors_are_tests_of_the_telescope(
    tmp_path: Path, folders: list[str], left_out: bool
) -> None:
    """Two may be lidars of two places."""
    for number, folder in enumerate([*folders, "evening"]):
        write(tmp_path / f"raw/{folder}/h{number}", content(number, seed=number))
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    found = {granule.path.rpartition("/")[0] for granule in granules(campaign)}
    assert found == {"evening"} | (set() if left_out else set(folders))
    assert (f"# {len(folders)} files, ? test of the telescope" in text) == left_out


def test_a_campaign_is_named_after_its_stations(raw: Path, tmp_path: Path) -> None:
    campaign, _ = drafted(raw, tmp_path / "campaign.yaml")
    assert campaign.name == "coast-hill"
    assert campaign.title == "Lidar measurements at Coast, Hill"


def test_the_altitude_of_a_station_is_that_of_most_headers(tmp_path: Path) -> None:
    for number, altitude in enumerate((906.0, 20.0, 20.0)):
        write(tmp_path / f"raw/h{number}", content(number, altitude=altitude))
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert campaign.stations["coast"].altitude == 20.0


def test_a_clock_hour_that_is_there_twice_is_a_question(tmp_path: Path) -> None:
    """Local time at the end of summer time; a second of rounding is none."""
    for number, minutes in enumerate([0.0, 59.0 / 60.0, 30.0, 30.5]):
        write(tmp_path / f"raw/h{number}", content(minutes, seed=number))
    _, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert "; files that start before another one stops: 1; is a clock hour there twice?" in text


def test_each_telescope_has_the_nitrogen_channel_of_the_nearest_recorder(data_root: Path) -> None:
    """IPRAL: BC0 to BC5 of the far telescope, BC10 to BC12 of the near one."""
    contents = read_folder(str(data_root / "cases/telescope_off"))
    (headers,) = drafted_instruments(contents).values()
    found = {name: headers.nitrogen_channels[name] for name in ("photon_355p", "photon_355o")}
    assert found == {"photon_355p": "photon_387o", "photon_355o": "photon_387o_2"}


def test_a_bin_shift_of_a_channel_without_photon_counting_is_a_question(
    data_root: Path, tmp_path: Path
) -> None:
    _, text = drafted(data_root / "cases/telescope_off", tmp_path / "campaign.yaml")
    shifted = [line for line in text.splitlines() if "states a bin shift of 9" in line]
    assert [line.split()[0] for line in shifted] == ["analog_1064o:"]


def test_files_in_an_archive_without_compression_are_packed_ones(tmp_path: Path) -> None:
    """Their headers can be read in it, as those of a raw file."""
    for number in range(2):
        write(tmp_path / f"raw/h{number}", content(number))
    with ZipFile(tmp_path / "raw/night.zip", "w") as archive:
        archive.write(tmp_path / "raw/h0", "h0")
    _, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert "# 1 file, ? packed and not read: unpack them, and run init again:" in text


def test_a_dataset_without_bits_is_named_in_draft_and_catalog(tmp_path: Path) -> None:
    whole = content()
    assert whole.count(b" 12 000600 ") == 1
    write(tmp_path / "raw/h00", whole.replace(b" 12 000600 ", b" 00 000600 "))
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    words = "analog_532o (BT0) states 0 bits and is left out"
    assert text.count(f"    # {words}\n") == 1
    (granule,) = granules(campaign)
    assert words in granule.notes


def test_the_session_folders_of_a_night_are_told_apart(data_root: Path, tmp_path: Path) -> None:
    case = data_root / "cases/session_folders"
    campaign, text = drafted(case, tmp_path / "campaign.yaml")
    known = {(path.split("/")[4][:2], granule.role) for granule in granules(campaign)
             for path in [granule.path]}  # fmt: skip
    assert known == {("RS", Role.SIGNAL), ("DC", Role.DARK)}
    assert "10 files, ? calibration of the polarisation" in text
    assert "/+45/" in text
    assert "/-45/" in text


@pytest.mark.parametrize(
    ("hour", "question"), [(10, "-18000 for UTC-5"), (5, "headers are +5 h from names")]
)
def test_names_by_another_time_than_headers_are_a_question(
    tmp_path: Path, hour: int, question: str
) -> None:
    for number in range(3):
        write(tmp_path / f"raw/h26301{hour:02d}.{number:02d}0000", content(600.0 + number))
    _, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert question in next(line for line in text.splitlines() if "clock_offset" in line)


def test_a_start_far_from_those_beside_it_by_name_is_a_question(tmp_path: Path) -> None:
    """Names tell no time; one file is of another year, and one session of another day."""
    for number, minutes in enumerate([600, 601, -500_000, 603, 604, 9000, 9001]):
        write(tmp_path / f"raw/night{number}", content(minutes))
    _, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    question = next(line for line in text.splitlines() if "clock_offset" in line)
    assert "; night2 is more than a day away from the files beside it by name, night1 (" in question


@pytest.mark.parametrize("free", [True, False])
def test_names_that_tell_no_time_are_a_question_and_a_clock_far_from_them_is_none(
    tmp_path: Path, free: bool
) -> None:
    """Of a clock without battery, all files are as far from their names."""
    days = [3, 17, 5, 28, 11] if free else [13] * 5
    for number, day in enumerate(days):
        name = f"h265{day:02d}{10 + number}.000000"
        data = content(600.0 + number)
        first, rest = data.split(b"\r\n", 1)
        data = b" ".join([f" {name}".encode()]).ljust(len(first)) + b"\r\n" + rest
        write(tmp_path / "raw" / name, data)
    if not free:
        shown = CliRunner().invoke(app, ["init", str(tmp_path / "raw"), str(tmp_path / "c.yaml")])
        assert "states 2026-03-01 10:00, the name of the file in its first line" in shown.output
        assert "(leave the file out, or correct its header)" in " ".join(shown.output.split())
        return
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert "name_times: ignored  # ? states 2026-03-01 10:00, the name of the file" in text
    for checked, status in ((False, Status.GOOD), (True, Status.REFUSED)):
        if checked:
            path = tmp_path / "campaign.yaml"
            path.write_text(text.replace("name_times: ignored", "name_times: checked"))
            campaign = load_campaign(path)
        result = bring_up_to_date(campaign)
        assert {granule.status for granule in granules(campaign)} == {status}
        assert not result.set_aside


def test_the_letters_of_a_station_are_no_words(tmp_path: Path) -> None:
    for number in range(3):
        write(tmp_path / f"raw/dc26{number}", content(number, seed=number))
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert {granule.role for granule in granules(campaign)} == {Role.SIGNAL}


@pytest.mark.parametrize(
    ("laser", "line", "elastic"),
    [(532, 529, False), (532, 530, False), (532, 535, False), (532, 540, True), (694, 692, False)],
)
def test_rotational_raman_lines_are_not_proposed_as_elastic(
    tmp_path: Path, laser: int, line: int, elastic: bool
) -> None:
    for number in range(2):
        data = content(number, seed=number, zenith_angle=0.0)
        # The analog record becomes that of the other line.
        data = data.replace(b"00532.o 0 0 00 000 12", f"00{line}.o 0 0 00 000 12".encode())
        data = data.replace(b"00532.o", f"00{laser}.o".encode())
        write(tmp_path / f"raw/h{number}", data)
    campaign, _ = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (lidar,) = campaign.instruments.values()
    proposed = lidar.products.requested["elastic"].channels
    assert (f"photon_{laser}o" in proposed, f"analog_{line}o" in proposed) == (True, elastic)


@pytest.mark.parametrize(("slanted", "kind"), [(2, "elastic"), (6, "multiangle")])
def test_a_fixed_lidar_with_some_slanted_files_is_no_scan(
    tmp_path: Path, slanted: int, kind: str
) -> None:
    """Two of twenty, as for a test; six are a part of what it does."""
    for number in range(20):
        angle = 40.0 if number >= 20 - slanted else 5.0
        write(tmp_path / f"raw/h26{number:02}", content(number, seed=number, zenith_angle=angle))
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (lidar,) = campaign.instruments.values()
    assert set(lidar.products.requested) == {"signal", kind}
    assert "# zenith_angle: the beam moves from 5 to 40 degree by the headers" in text
