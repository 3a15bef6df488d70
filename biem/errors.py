"""The failure that is no fault of the input: a step that could not be made."""


class NumericalFailure(RuntimeError):
    """A computation that did not converge or left the valid states; the message names the numbers."""
