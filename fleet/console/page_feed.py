"""The base of the feeds: the data of a console page besides the state of the cars.

Each feed registers the messages of its page, and answers them.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

from fleet.console.page_link import PageLink
from fleet.console.page_requests import PageMessage

Handler = Callable[[PageLink, PageMessage], None]
"""Handles one message of a page. If the message is wrong, it raises BadPageMessage and changes nothing."""


class PageFeed(ABC):
    """The data of one kind of page, for all pages that show it. All methods run on the loop."""

    @property
    @abstractmethod
    def messages(self) -> Mapping[str, Handler]:
        """The handlers of the messages that a page of this kind sends, by the `t` of a message."""

    def on_page(self, page: PageLink) -> None:  # noqa: ARG002 - a page may begin empty
        """Greet a new page."""
        return

    @abstractmethod
    def tick(self, pages: Mapping[int, PageLink]) -> None:
        """Show the pages what is new, ten times a second."""

    def end(self, page: int) -> None:  # noqa: ARG002 - a feed may know no page
        """Forget a page that has gone."""
        return
