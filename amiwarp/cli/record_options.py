"""Options made of the fields of a dataclass: name, type, and the text below the field as help."""

from collections.abc import Callable, Collection
from dataclasses import fields, make_dataclass
from typing import Annotated, Any, TypeVar, get_type_hints

from amiwarp.schema.field_texts import field_texts

Group = TypeVar("Group", bound=type)
"""Class of options."""


def with_options_of(
    record: type[Any], option: Callable[..., Any], *, leave_out: Collection[str] = ()
) -> Callable[[Group], Group]:
    """Decorate a dataclass of options, which gets an option for each field of another dataclass.

    An option that is not given is None: the record's own default then holds.

    Parameters
    ----------
    record : type
        The dataclass. The first paragraph below each of its fields is the help, with units in parentheses.
    option : callable
        Makes an option of its help, such as ``typer.Option`` with a panel.
    leave_out : collection of str
        Fields without an option, or for which the class has one of its own.
    """
    hints = get_type_hints(record)
    texts = field_texts(record)

    def decorate(group: Group) -> Group:
        made = []
        for field in fields(record):
            if field.name in leave_out:
                continue
            text = texts.get(field.name, f"Field {field.name} of amiwarp.{record.__name__}.")
            help_text = text.replace("[", "(").replace("]", ")").replace("``", "")
            made.append((field.name, Annotated[hints[field.name] | None, option(help=help_text)]))
        names = {"__module__": group.__module__, "__doc__": group.__doc__}
        options = [(name, annotation, None) for name, annotation in made]
        return make_dataclass(  # type: ignore[return-value]
            group.__name__, options, bases=(group,), namespace=names, frozen=True
        )

    return decorate
