"""Car following: pairs with published results, platoons, people behind automated cars."""

from studies.printed import published

#: Published figures.
printed = published(__name__)
