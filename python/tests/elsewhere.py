"""What tests call in another process."""


def block(s):
    """All numbers of an instance."""
    return s.__reduce__()[1][6]


def in_another_process(s):
    """The result of some steps, and the instance after them."""
    return s.hold(100, 2e-3), block(s)


def model_elsewhere(model):
    """The result of some steps of a new instance."""
    return model.start(step="10 us").hold(100, 1e-3)
