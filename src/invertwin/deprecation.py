"""Old spellings of the API: they work for one version, with a warning that names the new one."""

import inspect
import sys
import tomllib
import warnings
from collections.abc import Callable
from functools import cache, partial, reduce, wraps
from importlib.resources import files
from typing import Any, TypeVar, cast

_Function = TypeVar("_Function", bound=Callable[..., Any])


def warn_renamed(old: str, new: str, stacklevel: int = 3) -> None:
    """Issue a DeprecationWarning of one line, "old → new".

    Args:
        old: the deprecated spelling.
        new: the spelling to use instead.
        stacklevel: frames from this function to the line that the warning points at.
    """
    warnings.warn(f"deprecated: {old} → {new}", DeprecationWarning, stacklevel=stacklevel)


def rename_attributes(module: str) -> None:
    """Let a module, its classes and its functions know the old names of ``renamed.toml``.

    It sets the module's ``__getattr__``, so that type checkers know the new names alone. Call it
    where the classes and functions are defined, or where users get them from.

    Args:
        module: dotted name of the module, ``__name__``.
    """
    package = module.partition(".")[0]
    found = vars(sys.modules[module])
    find_present = found.get("__getattr__")

    def find_attribute(name: str) -> Any:
        names = read_renamed_attributes().get(module, {})
        if name not in names:
            if find_present is not None:
                return find_present(name)
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        path = names[name]
        full = f"{package}.{path}" if "." in path else f"{module}.{path}"
        warn_renamed(f"{module}.{name}", full)
        return reduce(getattr, full.split(".")[1:], sys.modules[package])

    found["__getattr__"] = find_attribute
    for title, members in read_renamed_attributes().items():
        owner, _, name = title.rpartition(".")
        room, _, holder = owner.rpartition(".")
        place = sys.modules[module] if owner == module else found.get(holder, object)
        value = vars(place).get(name) if module in (owner, room) else None
        if isinstance(value, type):
            rename_members(value, **members)
        elif isinstance(value, classmethod):
            setattr(place, name, classmethod(rename_arguments(**members)(value.__func__)))
        elif inspect.isfunction(value):
            setattr(place, name, rename_arguments(**members)(value))


@cache
def read_renamed_attributes() -> dict[str, dict[str, str]]:
    """Read old names and the new ones, by dotted name of the module, class or function."""
    text = files(__name__.partition(".")[0]).joinpath("renamed.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


class RenamedMember:
    """Member of a class by its old name: the member of the new name, with a warning.

    Attributes of an instance, and members of a subclass, of the old name are found first.
    """

    def __init__(self, old: str, new: str) -> None:
        """Name the member.

        Args:
            old: the old name.
            new: the new name, or a dotted path; see ``rename_members``.
        """
        self.old, self.new = old, new

    def __get__(self, instance: Any, owner: type) -> Any:
        """Return the member of the new name, of an instance or of the class."""
        if instance is None and self.old in owner.__annotations__:
            # A dataclass asks whether its own field of this name has a default.
            raise AttributeError(f"type object {owner.__name__!r} has no attribute {self.old!r}")
        if "." not in self.new:
            value = getattr(owner if instance is None else instance, self.new)
            warn_renamed(f"{owner.__name__}.{self.old}", f"{owner.__name__}.{self.new}")
            return value
        package = __name__.partition(".")[0]
        function: Any = reduce(getattr, self.new.split("."), sys.modules[package])
        warn_renamed(f"{owner.__name__}.{self.old}", f"{package}.{self.new}")
        return function if instance is None else partial(function, instance)


def rename_members(cls: type, /, **names: str) -> None:
    """Let a class have members, and arguments of its constructor, by their old names.

    Type checkers know the new names alone.

    Args:
        cls: the class; its subclasses inherit the old names.
        names: old names and the new ones: members of the class, or dotted paths from the package
            to a function of the instance, such as ``viewer.show``.
    """
    for old, new in names.items():
        setattr(cls, old, RenamedMember(old, new))
    make = vars(cls).get("__init__")
    if make is not None:
        known = inspect.signature(make).parameters
        arguments = {old: new for old, new in names.items() if new in known}
        if arguments:
            cls.__init__ = rename_arguments(**arguments)(make)


def rename_arguments(**names: str) -> Callable[[_Function], _Function]:
    """Let a function take keyword arguments by their old names, with a warning.

    An old name prevails over the new one: ``dataclasses.replace`` gives both, the new one with the
    value that is to be replaced.

    Args:
        names: old names and the new ones.

    Returns:
        A decorator, which keeps the signature.
    """

    def decorate(function: _Function) -> _Function:
        title = function.__qualname__.removesuffix(".__init__")

        @wraps(function)
        def call(*given: Any, **options: Any) -> Any:
            for old in [name for name in options if name in names]:
                warn_renamed(f"{title}({old}=...)", f"{title}({names[old]}=...)")
                options[names[old]] = options.pop(old)
            return function(*given, **options)

        vars(call)["renamed_arguments"] = names
        return cast(_Function, call)

    return decorate
