"""Tables that are written by hand: what their docstrings say of their keys."""

from invertwin.registry.section import Section, Seed, argument_docs


class Lamp(Section):
    """A lamp.

    It shines.

    Attributes:
        power: W, of the
            bulb.
        seed: of the flicker
    """

    power: float
    seed: Seed = 3


class Lantern(Lamp):
    """A lamp to carry.

    Attributes:
        handle: kg
    """

    handle: float = 0.1


def test_keys_are_described_by_the_docstring_and_those_of_bases():
    schema = Lantern.model_json_schema()
    told = {name: key["description"] for name, key in schema["properties"].items()}
    assert told == {"power": "W, of the bulb", "seed": "of the flicker", "handle": "kg"}
    assert schema["required"] == ["power"]
    assert schema["properties"]["seed"]["default"] == 3


def test_the_description_of_a_table_ends_before_its_keys():
    assert Lamp.model_json_schema()["description"] == "A lamp.\n\nIt shines."


def test_arguments_of_one_line_share_a_text():
    def draw(low, high):
        """Draw.

        Args:
            low, high: ends [m].
        """

    assert argument_docs(draw) == {"low": "ends [m]", "high": "ends [m]"}
