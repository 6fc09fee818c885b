"""Entries come from decorators, from the package's own folder and from installed packages; each error says what there is."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from velap.errors import ConfigError, UnknownTaskError
from velap.registry import Registry


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry[Any]]:
    """A registry of greetings whose home has two modules; the first says when it is imported."""
    folder = tmp_path / "greetings"
    folder.mkdir()
    (folder / "__init__.py").write_text(
        "from velap.registry import Registry\nGREETINGS = Registry('greeting', 'greetings')\n")
    (folder / "english.py").write_text("from greetings import GREETINGS\n@GREETINGS.register('hello')\ndef hello(): ...\n")
    (folder / "french.py").write_text("from greetings import GREETINGS\nGREETINGS.add('salut', 'salut!')\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("greetings").GREETINGS
    for name in [name for name in sys.modules if name.split(".")[0] in ("greetings", "nordic")]:
        del sys.modules[name]


def install(folder: Path, **entries: str) -> None:
    """What `pip install` leaves of a package that declares entry points of the group `velap.greetings`."""
    info = folder / "nordic-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: nordic\nVersion: 1.0\n")
    lines = "\n".join(f"{name} = {value}" for name, value in entries.items())
    (info / "entry_points.txt").write_text(f"[velap.greetings]\n{lines}\n")
    (folder / "nordic.py").write_text("hei = 'hei!'\n")


def test_a_home_registers_itself_at_first_use(home: Registry[Any]) -> None:
    assert "greetings.english" not in sys.modules
    assert list(home) == ["hello", "salut"]
    assert home["hello"] is importlib.import_module("greetings.english").hello
    assert home["salut"] == "salut!"


def test_a_decorator_adds_and_returns_what_it_decorates(home: Registry[Any]) -> None:
    @home.register("servus")
    class Servus:
        pass

    assert home["servus"] is Servus
    assert "servus" in home
    home.register("servus")(Servus)
    with pytest.raises(ConfigError, match="two greetings are called 'servus'"):
        home.register("servus")(object())


def test_an_unknown_name_is_answered_with_the_known_ones(home: Registry[Any]) -> None:
    with pytest.raises(UnknownTaskError, match=r"greeting 'moin'; expected one of hello, salut\..*velap.register_greeting"):
        home["moin"]


def test_an_installed_package_is_named_and_imported_when_asked_for(home: Registry[Any], tmp_path: Path) -> None:
    install(tmp_path, hei="nordic:hei", god_dag="nordic:missing")
    assert list(home) == ["hello", "salut", "hei", "god_dag"]
    assert "nordic" not in sys.modules
    assert home["hei"] == "hei!"
    with pytest.raises(ConfigError, match=r"greeting 'god_dag' of the entry point 'nordic:missing' cannot be imported"):
        home["god_dag"]
    assert home["hello"], "a broken package breaks nothing but itself"
