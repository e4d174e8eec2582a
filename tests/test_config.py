"""Options from files and words: their names and types are those of `Options`, and what comes later wins."""

from __future__ import annotations

import tempfile
import tomllib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnrecon.config import Settings, read_settings, settings_text, typed
from gnrecon.options import Options
from gnrecon.runtime.errors import InputError, UsageError


def config(folder: Path, text: str) -> Path:
    path = folder / "some.toml"
    path.write_text(text)
    return path


def test_what_comes_later_wins(tmp_path: Path) -> None:
    text = """
    resolution = 100
    quality = "draft"
    max-points = 1000
    seed = 1
    [scans."*.ply"]
    quality = "high"
    seed = 2
    timeout = "2h"
    [scans."left/*"]
    seed = 3
    """
    settings = read_settings(config(tmp_path, text), ["max_points=500"], {"threads": 2})
    everywhere = {"resolution": 100, "max_points": 500, "threads": 2}
    assert settings.of(Path("s/a.xyz")) == {**everywhere, "quality": "draft", "seed": 1}
    assert settings.of(Path("s/a.ply")) == {**everywhere, "quality": "high", "seed": 2, "timeout": "2h"}
    assert settings.of(Path("s/left/a.ply")) == {**everywhere, "quality": "high", "seed": 3, "timeout": "2h"}
    given = replace(settings, given={"seed": 9, "quality": "normal"})
    assert given.of(Path("left/a.ply"))["seed"] == 9
    assert given.of(Path("left/a.ply"))["quality"] == "normal"


def test_a_reference_lies_beside_the_configuration(tmp_path: Path) -> None:
    settings = read_settings(config(tmp_path, '[scans."a.*"]\nreference = "truth/a.obj"\n'), [], {})
    assert settings.of(Path("a.ply")) == {"reference": tmp_path / "truth" / "a.obj"}
    assert settings.of(Path("b.ply")) == {}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("resolution = ", "is not TOML"),
        ("resolutions = 3", "there is no option 'resolutions'; perhaps you mean 'resolution'"),
        ("resolution = 'fine'", "resolution must be a whole number, not 'fine'"),
        ("resolution = 1.5", "resolution must be a whole number, not 1.5"),
        ("adaptive = 1", "adaptive must be true or false, not 1"),
        ("quality = 3", "quality must be text, not 3"),
        ("widths = ['a']", "widths must be a list of whole numbers such as 2000 or 32,32,32, not"),
        ("max-points = 1\nmax_points = 2", "max_points is there twice"),
        ("scans = 3", "go into tables such as"),
        ("[scans]\nseed = 3", "go into tables such as"),
        ("[scans.'']\nseed = 3", "has no pattern that a path could match"),
        ("[scans.'./']\nseed = 3", "has no pattern that a path could match"),
        ("[scans.'a*']\nsead = 3", r"a\*: there is no option 'sead'; perhaps you mean 'seed'"),
    ],
)
def test_configurations_that_make_no_sense(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises((UsageError, InputError), match=sentence) as caught:
        read_settings(config(tmp_path, text), [], {})
    assert "some.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_words_that_make_no_sense(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--set expects NAME=VALUE, not 'seed'"):
        read_settings(None, ["seed"], {})
    with pytest.raises(UsageError, match="--set: there is no option 'sead'"):
        read_settings(None, ["sead=3"], {})
    with pytest.raises(UsageError, match="The option seed is given twice, by --set and by its own name"):
        read_settings(None, ["seed=3"], {"seed": 4})
    with pytest.raises(InputError, match=r"The configuration .*none\.toml cannot be read: No such file"):
        read_settings(tmp_path / "none.toml", [], {})


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("seed", "3", 3),
        ("widths", "32,32", (32, 32)),
        ("widths", "[32, 16]", (32, 16)),
        ("widths", "2000", (2000,)),
        ("curvature", "true", True),
        ("spacing", "2s", "2s"),
        ("spacing", "2", 2.0),
        ("simplify", "1", 1.0),
        ("simplify", "1e-3", 0.001),
        ("quality", "high", "high"),
        ("crop", "0,0,0,1,1,1", ("0,0,0,1,1,1",)),
    ],
)
def test_words_are_read_as_their_options_are(name: str, text: str, value: Any) -> None:
    assert read_settings(None, [f"{name}={text}"], {}).given == {name: value}


def test_every_option_has_a_type_that_can_be_written() -> None:
    for option in fields(Options):
        if option.default is not None:
            value = list(option.default) if isinstance(option.default, tuple) else option.default
            assert typed(option.name, value) == option.default, option.name


OPTIONS = st.builds(
    Options,
    seed=st.integers(0, 2**40),
    widths=st.none() | st.lists(st.integers(1, 99), min_size=1, max_size=3).map(tuple),
    resolution=st.none() | st.integers(16, 999),
    edge_length=st.none(),
    simplify=st.none() | st.floats(1e-6, 1e6),
    spacing=st.none() | st.floats(1e-6, 1e6) | st.just("2s"),
    curvature=st.booleans(),
    attributes=st.sampled_from(["auto", "none", "colors, é", 'a "b"']),
    crop=st.lists(st.just("0,0,0,1,1,1"), max_size=2).map(tuple),
)


@given(OPTIONS)
def test_options_in_effect_read_back_the_same(options: Options) -> None:
    text = settings_text({**options.as_dict(), "reference": Path("truth.obj")}, Path("a.ply"))
    assert text.startswith("# All options in effect, for a.ply, of gnrecon ")
    values = Settings(_read(text)).of(Path("a.ply"))
    assert values.pop("reference") == Path("truth.obj").absolute()
    assert Options(**values) == options


def _read(text: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        return dict(read_settings(config(Path(folder), text), [], {}).general)


def test_an_edge_length_in_effect_reads_back_without_a_resolution(tmp_path: Path) -> None:
    options = Options(edge_length=0.5)
    values = read_settings(config(tmp_path, settings_text(options.as_dict(), Path("a"))), [], {}).of(Path("a"))
    assert Options(**values) == options


def test_no_name_of_a_scan_becomes_an_option() -> None:
    text = settings_text({"seed": 1}, Path("a\nsteps = 5 #\x1b[31m\udcff.xyz"))
    assert tomllib.loads(text) == {"seed": 1}
