"""A session whose touches are made well."""

from studies.true_cell import World as World


def taken(session, world, numbers):
    """The session after touches of the plan that were made well."""
    for number in numbers:
        session = session.take(*world.touch(number), number=number)
        assert session.alarm is None, f"touch {number}"
    return session
