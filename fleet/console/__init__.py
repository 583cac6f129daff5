"""The console: a web page that shows the fleet, drives cars and stops them. One more client of the bus.

Read `server` first: it serves the page and one WebSocket per page, and `console` wires the rest. `operator` sends the
commands of one person (`operators`: of all), `page_link` the messages to a page. A page that shows more than the cars
has a `page_feed`, which registers its messages: `plan_feed`, `plot_feed`, `inspections`. `lan` serves the network, with
`certificate`, `people_file` and `people_routes`; its connections come in through `entrance`. `sessions_api` works on
recordings, `session_files` guards their folder, `plan_process` starts a coordinator, and `setup_api` finds cars. Pure:
`presses` (how long a car drives: the dead-man), `guard` (which requests are answered), `pairing` (codes, cookies and
people), `permissions` (who may do what), `waiting_room` (who may begin TLS), `connection_limit`, `requests`,
`car_view`, `command_ledger`, `plan_view`, `frame_log`, `plot_buffer`, `abilities` and `stop_report`.
"""
