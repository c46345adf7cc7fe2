"""What the scripts that try assets/python/dimos_client share."""


def refused(kind, code, act):
    """The error of a call that must be refused with a code."""
    try:
        act()
    except kind as error:
        assert error.code == code, error
        return error
    raise AssertionError(f"{code} was expected")


def near(a, b, by=0.01):
    """Whether two lists of numbers are the same within a tolerance."""
    return all(abs(x - y) <= by for x, y in zip(a, b))
