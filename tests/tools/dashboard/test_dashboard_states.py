"""The dashboard's page names faults of brokers, permissions and clocks, and draws every limb."""

from __future__ import annotations

import subprocess
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import aiomqtt
import pytest

from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress, parse_broker
from jointfit_daemon.tools.dashboard.server import DashboardServer
from tests.broker_fixture import HOST, free_port
from tests.tools.dashboard.browser import SIZES, OpenedPage, chromium, opened
from tests.tools.dashboard.example_rig import EXAMPLES, ExampleRig
from tests.tools.dashboard.published_rig import PublishedRig, publishing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from playwright.async_api import Browser

    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(150)]


@pytest.fixture
async def browser() -> AsyncIterator[Browser]:
    async with chromium() as started:
        yield started


@asynccontextmanager
async def page_of(
    browser: Browser, server: DashboardServer, query: str = ""
) -> AsyncIterator[OpenedPage]:
    """Yield the page of a server; require that it reports no errors and stays in its origin."""
    async with (
        server.listening(ListenAddress(HOST, 0)) as url,
        opened(browser, url + query) as page,
    ):
        yield page
        assert page.errors == []


async def show_state(page: OpenedPage, name: str) -> None:
    """Save screenshots of a state in both themes and two sizes; check accessibility."""
    for size in ("phone", "desktop"):
        width, height = SIZES[size]
        await page.page.set_viewport_size({"width": width, "height": height})
        for scheme in ("light", "dark"):
            await page.page.emulate_media(color_scheme=scheme)
            await page.picture(f"state-{name}-{size}-{scheme}")
            assert await page.accessibility_faults() == [], (size, scheme)
        overflow = "document.documentElement.scrollWidth - innerWidth"
        assert await page.page.evaluate(overflow) <= 0, size


def server_of(broker: Broker) -> DashboardServer:
    return DashboardServer(BrokerAddress(HOST, broker.port))


async def test_a_missing_broker_is_named_with_its_address(browser: Browser) -> None:
    port = free_port()
    async with page_of(browser, DashboardServer(BrokerAddress(HOST, port))) as page:
        await page.until_text("#banner", f"No connection to the broker at {HOST}:{port}")
        await page.until_text("#banner", "start the broker, or correct --broker")
        assert await page.text("#rig-state") == "Connection lost"
        await show_state(page, "no-broker")


ACCOUNTS = {"jointfitd": "d", "viewer": "v", "half": "h"}


@pytest.fixture
def restricted(tmp_path: Path, start_mosquitto: Callable[[str], Broker]) -> Broker:
    """Return a mosquitto broker with accounts and the access list of the documentation."""
    passwords, rights = tmp_path / "passwords", tmp_path / "rights"
    passwords.touch()
    for name, password in ACCOUNTS.items():
        subprocess.run(["mosquitto_passwd", "-b", passwords, name, password], check=True)
    rights.write_text(
        "user jointfitd\ntopic readwrite jointfit/bench-1/#\n"
        "user viewer\ntopic read jointfit/bench-1/#\n"
        "user half\ntopic read jointfit/bench-1/bridge/state\ntopic read jointfit/bench-1/pose/ui\n"
        "topic read jointfit/bench-1/device/+/availability\n",
        encoding="utf-8",
    )
    return start_mosquitto(f"allow_anonymous false\npassword_file {passwords}\nacl_file {rights}\n")


async def log_in(page: OpenedPage, name: str, password: str) -> None:
    await page.page.fill("#login-user", name)
    await page.page.fill("#login-password", password)
    await page.page.click("#login-send")


async def test_a_wrong_password_is_named_and_the_right_one_continues(
    browser: Browser, restricted: Broker
) -> None:
    rig = PublishedRig(account=("jointfitd", "d"))
    async with publishing(rig, restricted.port), page_of(browser, server_of(restricted)) as page:
        await page.until_text("#login-reason", "asks for a user name and a password")
        await log_in(page, "viewer", "wrong")
        await page.until_text("#login-reason", "refuses the user name viewer or its password")
        await page.until_text("#banner", "refuses the user name viewer or its password")
        assert await page.text("#main-action") == "Log in"
        assert await page.page.evaluate("document.activeElement.id") == "login-password"
        await show_state(page, "wrong-password")
        await log_in(page, "viewer", "v")
        await page.until_text("#angle-value", "°")


async def test_an_account_that_may_not_send_requests_is_told_so(
    browser: Browser, restricted: Broker
) -> None:
    rig = PublishedRig(account=("jointfitd", "d"))
    async with publishing(rig, restricted.port), page_of(browser, server_of(restricted)) as page:
        await page.until_text("#login-reason", "asks for a user name")
        await log_in(page, "viewer", "v")
        await page.until_text("#notices", "The account viewer can watch only")
        await page.until_text("#recording", "This account can watch only")
        assert await page.page.is_disabled("#recording .stop-recording")
        await show_state(page, "viewer")
        assert "receives nothing" not in await page.text("#notices")


async def test_topics_hidden_by_the_access_list_are_listed_with_what_is_missing(
    browser: Browser, restricted: Broker
) -> None:
    rig = PublishedRig(account=("jointfitd", "d"))
    async with (
        publishing(rig, restricted.port),
        page_of(browser, server_of(restricted), f"?base={rig.base}") as page,
    ):
        await page.until_text("#login-reason", "asks for a user name")
        await log_in(page, "half", "h")
        await page.until_text("#notices", "The account half receives nothing from bridge/info")
        notice = await page.text("#notices")
        for topic in ("bridge/info", "bridge/health", "calibration"):
            assert topic in notice
        for readable in ("bridge/state", "pose/ui", "availability"):
            assert readable not in notice
        assert "Waiting" not in await page.page.inner_text("body")
        await show_state(page, "hidden-topics")


async def test_a_daemon_of_another_version_is_named_until_it_is_replaced(
    browser: Browser, broker: Broker
) -> None:
    async with page_of(browser, server_of(broker)) as page:
        async with publishing(PublishedRig(version=2), broker.port):
            await page.until_text("#rig-state", "jointfitd has another version")
            await page.until_text("#notices", "sends payloads of version 2. This page")
            assert await page.text("#angle-value") == "–"
            await show_state(page, "other-version")
        async with publishing(PublishedRig(), broker.port):
            await page.until_text("#angle-value", "°")
            assert not await page.page.is_visible("#notices")


@pytest.mark.parametrize(("offset_h", "words"), [(-9, "9 h behind"), (30, "30 h ahead of")])
async def test_clocks_that_are_hours_apart_are_named_and_ages_are_right(
    browser: Browser, broker: Broker, offset_h: int, words: str
) -> None:
    rig = PublishedRig(clock_offset_s=offset_h * 3600)
    async with publishing(rig, broker.port), page_of(browser, server_of(broker)) as page:
        await page.until_text("#notices", f"The clock of the gateway is {words}")
        event = (
            f'{{"v":1,"t_us":{rig.now_us() - 300_000_000},"level":"warning","kind":"source",'
            '"id":"S1","text":"no data"}'
        )
        async with aiomqtt.Client(HOST, broker.port, protocol=aiomqtt.ProtocolVersion.V5) as client:
            await client.publish(f"{rig.base}/bridge/event", event)
        await page.until_text("#cards", "5 min ago: no data")
        if offset_h < 0:
            await show_state(page, "clocks")


async def test_a_message_of_another_program_is_ignored_and_named(
    browser: Browser, broker: Broker
) -> None:
    rig = PublishedRig()
    async with publishing(rig, broker.port), page_of(browser, server_of(broker)) as page:
        await page.until_text("#angle-value", "°")
        async with aiomqtt.Client(HOST, broker.port, protocol=aiomqtt.ProtocolVersion.V5) as client:
            for noise in ("[]", "3", "{", "null", '{"v":1,"joints":3}', '{"v":1,"t_us":"now"}'):
                for topic in (
                    "bridge/info",
                    "pose/ui",
                    "calibration",
                    "bridge/health",
                    "device/x/info",
                ):
                    await client.publish(f"{rig.base}/{topic}", noise)
        await page.until_text(
            "#notices", "was ignored: its content is not in the format of jointfitd"
        )
        await page.until_text("#angle-value", "°")


async def test_a_tcp_port_in_place_of_a_websocket_is_named(
    browser: Browser, mosquitto: Broker
) -> None:
    server = DashboardServer(parse_broker(f"ws://{HOST}:{mosquitto.port}"))
    async with page_of(browser, server) as page:
        await page.until_text("#banner", f"No WebSocket at ws://{HOST}:{mosquitto.port}")
        await page.until_text("#banner", "not its TCP port")
        await show_state(page, "no-websocket")


async def test_a_broker_in_the_address_is_used_only_if_the_server_names_it(
    browser: Browser, broker: Broker, start_mosquitto: Callable[[str], Broker]
) -> None:
    elsewhere = "?broker=wss://attacker.example/"
    async with (
        publishing(PublishedRig(), broker.port),
        page_of(browser, server_of(broker), elsewhere) as page,
    ):
        await page.until_text("#notices", "asks for the broker wss://attacker.example/")
        await page.until_text("#angle-value", "°")
        assert not any(url.startswith("wss://attacker") for url in page.requests)

    port = free_port()
    direct = start_mosquitto(f"listener {port} {HOST}\nprotocol websockets\n")
    server = DashboardServer(parse_broker(f"ws://{HOST}:{port}/"))
    async with (
        publishing(PublishedRig(), direct.port),
        page_of(browser, server, f"?broker=ws://{HOST}:{port}/") as page,
    ):
        await page.until_text("#angle-value", "°")
        assert not await page.page.is_visible("#notices")


ONE_SEGMENT = (
    '[rig]\nname = "foot"\n[chain]\njoints = ["ankle", "toe"]\nsegments = ["foot"]\n'
    '[[imu]]\nid = "S1"\nsegment = "foot"\ndriver = "xbus"\nport = "/dev/ttyUSB0"\nbaud = 921600\n'
)


def many_segments(count: int) -> str:
    """Return a rig.toml with a chain of segments."""
    names = [f"segment_{i}" for i in range(count)]
    joints = [f"joint_{i}" for i in range(count + 1)]
    imus = (
        f'[[imu]]\nid = "S{i}"\nsegment = "{name}"\ndriver = "xbus"\nport = "/dev/ttyUSB{i}"\n'
        "baud = 921600\n"
        for i, name in enumerate(names)
    )
    return f'[rig]\nname = "chain"\n[chain]\njoints = {joints}\nsegments = {names}\n{"".join(imus)}'


@pytest.mark.parametrize("name", ["one", "six", "legs", "arm", "trunk"])
async def test_limbs_of_any_shape_are_drawn_on_every_screen(
    browser: Browser, broker: Broker, tmp_path: Path, name: str
) -> None:
    file = EXAMPLES / f"{name}.toml"
    if name in ("one", "six"):
        file = tmp_path / "rig.toml"
        file.write_text(ONE_SEGMENT if name == "one" else many_segments(6), encoding="utf-8")
    rig = ExampleRig(file=file)
    async with publishing(rig, broker.port), page_of(browser, server_of(broker)) as page:
        if name == "one":
            await page.until_text("#angle-reason", "one segment has no joint angle")
        else:
            await page.until_text("#angle-value", "°")
        await page.until_text("#limb-caption", "±")
        assert await page.page.locator("#cards article").count() == len(rig.devices)
        await show_state(page, f"limb-{name}")


NAMES = {
    "arabic": {"الفخذ الأيمن": ["مستشعر أ", "مستشعر ب"], "الساق": ["مستشعر ج", "S4"]},
    "chinese": {"大腿": ["传感器一", "传感器二"], "小腿": ["传感器三", "传感器四"]},
    "emoji-html": {
        "🦵🏽<img src=x onerror=alert(1)>": ["<b>S1", "🙂"],
        "shank": ["<script>", "a&amp;b"],
    },
    "long": {"upper" * 20: ["sensor" * 12, "S2"], "lower" * 20: ["S3", "S4"]},
}


@pytest.mark.parametrize("script", NAMES)
async def test_names_in_any_script_are_shown_as_they_are(
    browser: Browser, broker: Broker, script: str
) -> None:
    sensors = NAMES[script]
    rig = PublishedRig(" · ".join(sensors), sensors)
    async with publishing(rig, broker.port), page_of(browser, server_of(broker)) as page:
        await page.until_text("#angle-value", "°")
        assert await page.text("#rig-name") == rig.name
        titles = await page.page.locator("#cards article h3").all_text_contents()
        assert titles == [*rig.devices]
        for segment in sensors:
            await page.until_text("#limb-caption", segment[1:])
        elements = "document.querySelectorAll('#views img, #views b, #views script').length"
        assert await page.page.evaluate(elements) == 0
        if script == "arabic":
            direction = "getComputedStyle(document.querySelector('#cards h3')).direction"
            assert await page.page.evaluate(direction) == "rtl"
        await show_state(page, f"names-{script}")


GAPS = """() => {
  const [times, values] = jointfit.angle.chart.data;
  return values.filter((value, i) => value === null && i > 0 && i < values.length - 1).length;
}"""


@pytest.fixture(params=["mosquitto", "embedded_broker"])
def each_broker(request: pytest.FixtureRequest) -> Broker:
    found: Broker = request.getfixturevalue(request.param)
    return found


async def test_daemon_broker_and_server_are_lost_and_regained_with_a_gap_in_the_curve(
    browser: Browser, each_broker: Broker
) -> None:
    rig = PublishedRig()
    server = server_of(each_broker)
    listen = ListenAddress(HOST, free_port())
    async with server.listening(listen) as url, opened(browser, url) as page:
        async with publishing(rig, each_broker.port):
            await page.until_text("#angle-value", "°")
        await page.until_text("#banner", "jointfitd stopped or lost its broker")
        await page.until_text("#recording", "it completes the file that it was writing")
        await show_state(page, "no-daemon")
        async with publishing(rig, each_broker.port):
            await page.until_text("#angle-value", "°")
            await page.page.wait_for_function(GAPS)

            each_broker.stop()
            await page.until_text(
                "#banner", f"No connection to the broker at {HOST}:{each_broker.port}"
            )
            each_broker.start()
            await page.until_text("#angle-value", "°")
            await page.page.wait_for_selector("#banner", state="hidden")

            each_broker.freeze()
            await page.until_text(
                "#banner", f"The broker at {HOST}:{each_broker.port} does not answer"
            )
            each_broker.thaw()
            await page.until_text("#angle-value", "°")
        assert page.errors == []


async def test_a_lost_server_is_named_and_the_page_returns_with_it(
    browser: Browser, broker: Broker
) -> None:
    listen = ListenAddress(HOST, free_port())
    async with publishing(PublishedRig(), broker.port):
        async with server_of(broker).listening(listen) as url:
            context = opened(browser, url)
            page = await context.__aenter__()
            await page.until_text("#angle-value", "°")
        await page.until_text(
            "#banner", f"dashboard server at {HOST}:{listen.port} does not answer"
        )
        await page.until_text("#banner", "“jointfit dashboard” runs, and check the network")
        assert "Works" not in await page.text("#cards")
        await show_state(page, "no-server")
        async with server_of(broker).listening(listen):
            await page.until_text("#angle-value", "°")
            await page.page.wait_for_function(GAPS)
            await page.page.wait_for_selector("#banner", state="hidden")
        assert page.errors == []
        await context.__aexit__(None, None, None)


async def test_a_daemon_that_hangs_is_named(browser: Browser, broker: Broker) -> None:
    rig = PublishedRig()
    async with publishing(rig, broker.port), page_of(browser, server_of(broker)) as page:
        await page.until_text("#angle-value", "°")
        rig.silent = True
        await page.until_text("#banner", "sends no poses")
        rig.silent = False
        await page.until_text("#angle-value", "°")
        await page.page.wait_for_selector("#banner", state="hidden")
