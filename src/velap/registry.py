"""Registries of what can be added from outside: encoders, planners, methods, tasks and dataset readers.

An entry is added by one decorator:

    @register_planner("mine")
    def plan(fns, z_root, cfg, generator): ...

The package finds its own entries by importing the modules of one folder a kind, and those of installed packages by their
entry points, whose name is the entry's:

    [project.entry-points."velap.planners"]
    mine = "my_package.planning:plan"

Nothing is imported before an entry is asked for, so that `import velap` stays fast and a broken plugin breaks nothing but
itself.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from threading import RLock
from typing import Any, Generic, TypeVar

from velap.errors import ConfigError, UnknownTaskError

T = TypeVar("T")
Entry = TypeVar("Entry")


class Registry(MutableMapping[str, T], Generic[T]):
    """Entries of one kind by name: in their order where one module of the package has them all, else in the alphabet's."""

    def __init__(self, kind: str, home: str) -> None:
        """`home` is the module or folder of the package's own entries."""
        self.kind = kind
        """What an entry is, for messages."""
        self.group = f"velap.{kind}s"
        """Entry point group of other packages' entries."""
        self._home = home
        self._entries: dict[str, T] = {}
        self._complete = False
        self._importing = RLock()

    def register(self, name: str) -> Callable[[Entry], Entry]:
        """Decorator: adds what it decorates under `name` and returns it unchanged.

        Raises ConfigError where another entry has that name.
        """

        def add(entry: Entry) -> Entry:
            self.add(name, entry)  # type: ignore[arg-type]  # what an entry must be is the kind's protocol, checked by use
            return entry

        return add

    def add(self, name: str, entry: T) -> None:
        """Add an entry; raises ConfigError where another one has that name."""
        if self._entries.get(name, entry) is not entry:
            raise ConfigError(f"two {self.kind}s are called {name!r}: {self._entries[name]!r} and {entry!r}; expected one. "
                              "Give one of them another name.")
        self._entries[name] = entry

    def __setitem__(self, name: str, entry: T) -> None:
        """Put an entry in the place of another one."""
        self._entries[name] = entry

    def __delitem__(self, name: str) -> None:
        """Forget an entry."""
        del self._entries[name]

    @property
    def imported(self) -> Mapping[str, T]:
        """The package's own entries, and those of other packages that have been asked for."""
        self._import_home()
        return dict(self._entries)

    def __getitem__(self, name: str) -> T:
        """The entry of that name; raises UnknownTaskError with the names that exist."""
        self._import_home()
        if name not in self._entries:
            self._load_plugin(name)
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        """All names; entries of other packages are named without being imported."""
        spread = self._import_home()
        own = sorted(self._entries) if spread else self._entries
        return iter(dict.fromkeys((*own, *self._plugins())))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        self._import_home()
        return name in self._entries or name in self._plugins()

    def _import_home(self) -> bool:
        """Import every module of the home, whose decorators fill the registry; says whether it is a folder."""
        home = import_module(self._home)
        folder = getattr(home, "__path__", None)
        with self._importing:  # another thread waits until all are there
            if folder is not None and not self._complete:
                self._complete = True  # before the imports, which may look into the registry themselves
                try:
                    for module in pkgutil.iter_modules(folder):
                        import_module(f"{self._home}.{module.name}")
                except BaseException:
                    self._complete = False
                    raise
        return folder is not None

    def _plugins(self) -> dict[str, EntryPoint]:
        """Entry points of installed packages by name."""
        return {point.name: point for point in entry_points(group=self.group)}

    def _load_plugin(self, name: str) -> None:
        """Import an installed package's entry; raises UnknownTaskError where there is none of that name."""
        point = self._plugins().get(name)
        if point is None:
            raise UnknownTaskError(f"unknown {self.kind} {name!r}; expected one of {', '.join(self)}. Names are "
                                   f"case-sensitive; register one with velap.register_{self.kind}.")
        try:
            found = point.load()
        except Exception as error:
            raise ConfigError(f"the {self.kind} {name!r} of the entry point {point.value!r} cannot be imported: "
                              f"{type(error).__name__}: {error}. Repair or remove the package that declares it.") from error
        if name not in self._entries:
            self.add(name, found)


ENCODERS: Registry[Any] = Registry("encoder", "velap.models.encoders")
PLANNERS: Registry[Any] = Registry("planner", "velap.search")
METHODS: Registry[Any] = Registry("method", "velap.methods")
TASKS: Registry[Any] = Registry("task", "velap.tasks")
READERS: Registry[Any] = Registry("reader", "velap.data.readers")

register_encoder = ENCODERS.register
register_planner = PLANNERS.register
register_method = METHODS.register
register_task = TASKS.register
register_reader = READERS.register
