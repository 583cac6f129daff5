"""The console: a web page that shows the fleet, drives cars and stops them. It is one more client of the bus.

Read `server` first: it serves the page and one WebSocket per page. `console` wires the rest. `operator` sends the
commands of one person, and `operators` has one for each person. `page_link` sends the messages to a page. A page that
shows more than the cars has a `page_feed`, which registers the messages that the page may send: `plan_feed`,
`plot_feed`, `lane_feed`, `map_feed`, `inspect_feed`. `network_console` serves the network, with `certificate`,
`pairing`, `people_file` and `people_routes`. The network's connections come in through `tls_entrance`. `sessions_api`
works on recordings, `session_files` guards their folder, `plan_process` starts a coordinator, and `setup_api` finds
cars. Work that takes seconds runs in a `worker`: `plan_checks`, and `past_worker`, which answers the questions of
`past_api`. These modules are pure: `hold_to_drive` (the dead man's switch: how long a car drives), `request_filter`
(which requests are answered), `people_book` (codes, cookies and people), `guess_limit` (who must wait after wrong
codes), `rights_in_words` (who may do what), `waiting_room` (who may begin TLS), `connection_limit`, `page_requests`,
`car_view`, `past_view`, `command_ledger`, `plan_view`, `plan_answer`, `frame_log`, `plot_buffer`, `abilities` and
`stop_report`.
"""

from typing import Final

DEFAULT_PORT: Final = 7480
"""A port near that of the bus (7447)."""
