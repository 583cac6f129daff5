"""Reads a YAML text into a model, for the tests of models and of the document."""

from typing import TypeVar

from pydantic import BaseModel

from schemas.yaml_document.document import Document

Model = TypeVar("Model", bound=BaseModel)


def read_yaml(text: str, source: str, model: type[Model]) -> Model:
    """Read a model from a text. Raise BadFile for its faults."""
    document = Document(text, source)
    found = document.validate(model)
    document.raise_faults()
    assert found is not None
    return found
