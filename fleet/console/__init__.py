"""The console: a web page that shows the fleet, drives cars and stops them. One more client of the bus.

Read `server` first: it serves the page and one WebSocket per page, and `console` wires the rest. `operator` sends the
commands of one person (`operators`: of all), `page_link` the messages to a page. A page that shows more than the cars
has a `page_feed`, which registers its messages: `plan_feed`, `plot_feed`, `lane_feed`, `inspections`. `network_console`
serves the network, with `certificate`, `people_file` and `people_routes`; its connections come in through `entrance`.
`sessions_api` works on recordings, `session_files` guards their folder, `plan_process` starts a coordinator, and
`setup_api` finds cars. What takes seconds runs in a `worker`: `plan_checks`, and `past_worker` for the questions of
`past_api`. Pure: `hold_to_drive` (how long a car drives: the dead-man), `request_filter` (which requests are answered),
`pairing` (codes, cookies and people), `rights_in_words` (who may do what), `waiting_room` (who may begin TLS),
`connection_limit`, `page_requests`, `car_view`, `past_view`, `command_ledger`, `plan_view`, `plan_answer`, `frame_log`,
`plot_buffer`, `abilities` and `stop_report`.
"""

from typing import Final

DEFAULT_PORT: Final = 7480
"""A port near that of the bus (7447). Fleets of other names take those in between."""
