#!/bin/sh
# Makes a Raspberry Pi (or another Debian computer) the computer of one or more cars: their gateways start with it.
#
#   sudo deploy/install-car.sh --clone --car red --link /dev/ttyUSB0 --platform arduino
#
# It asks for nothing, and may be run again, also to upgrade. `--help` has the options. What it makes:
#
#   /opt/car-fleet                            the programs
#   /etc/systemd/system/car-*                 the services
#   /etc/udev/rules.d/70-fleet-cars.rules     names of cars on USB; edit it
#   /etc/car-fleet/CAR.env                    link, platform and options of a car; edit it
#   /var/lib/car-fleet                        certificate, e-stops and holds, of the user car-fleet
set -eu

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
package=zenoh-car-fleet
user='car-fleet'
prefix=''
wheel=''
clone=''
car=''
link=''
platform=auto
options=''
ble=''
all=''
uninstall=''

# What a gateway and `fleet join`, `list`, `stop`, `drive` import: 90 MB with the virtual environment's own tools. The
# whole package also brings what records and draws tables: another 50 MB.
needs='click>=8.1 cryptography>=44 eclipse-zenoh>=1.10.2,<2 foxglove-schemas-protobuf>=0.4.0 ifaddr>=0.2 msgspec>=0.22 protobuf>=7.35.1,<8 pyserial>=3.5 segno>=1.6 zeroconf>=0.140'
needs_ble='bleak>=3.1,<4'

usage() {
    cat <<'END'
usage: install-car.sh [--car NAME --link LINK [--platform P] [--options TEXT]] [--ble] [--all]
                      [--wheel FILE | --clone]
       install-car.sh --uninstall

  --car NAME        the gateway of this car starts with the computer; once for each run of this script
  --link LINK       its link: /dev/ttyUSB0, ble://ADDRESS, tcp://127.0.0.1:8888
  --platform P      arduino, stm32, raspberry_pi, ... (default: auto)
  --options TEXT    more options of `gateway run`
  --ble             also what Bluetooth links need
  --all             also hub, recorder, console, exporter, ...: for the computer of the hub
  --wheel FILE      install this file
  --clone           install the clone that this script is in. Without --clone and --wheel, the newest version comes from
                    PyPI, but none is published there yet
  --uninstall       remove what this script has made, apart from files that were changed since
  --prefix DIR      put everything below DIR, and start nothing (for tests)
END
}

fail() {
    echo "install-car.sh: $1" >&2
    exit "${2:-1}"
}

while [ $# -gt 0 ]; do
    case $1 in
        --car | --link | --platform | --options | --wheel | --prefix)
            [ $# -gt 1 ] || fail "$1 needs a value" 2
            case $1 in
                --car) car=$2 ;;
                --link) link=$2 ;;
                --platform) platform=$2 ;;
                --options) options=$2 ;;
                --wheel) wheel=$2 ;;
                --prefix) prefix=$2 ;;
            esac
            shift
            ;;
        --ble) ble=yes ;;
        --all) all=yes ;;
        --clone) clone=yes ;;
        --uninstall) uninstall=yes ;;
        -h | --help)
            usage
            exit 0
            ;;
        *) fail "there is no option $1 (--help shows them)" 2 ;;
    esac
    shift
done

if [ -n "$prefix" ]; then
    [ -d "$prefix" ] || fail "there is no directory $prefix" 2
    prefix=$(CDPATH='' cd -- "$prefix" && pwd)
fi
opt=$prefix/opt/car-fleet
units=$prefix/etc/systemd/system
rules=$prefix/etc/udev/rules.d/70-fleet-cars.rules
config=$prefix/etc/car-fleet
state=$prefix/var/lib/car-fleet
# What was made, one a line, in columns with tabs: `f PATH SUM` for a file, `d PATH` for a directory, `u NAME` for a user.
made=$opt/made.txt
tab=$(printf '\t')

[ -n "$prefix" ] || [ "$(id -u)" -eq 0 ] || fail "it must run as root: sudo $0 ..."

# With a prefix, or in a chroot, there is no systemd to be told.
has_systemd() {
    [ -z "$prefix" ] && [ -d /run/systemd/system ]
}

# A container may have systemd, but no udev.
has_udev() {
    [ -e /run/udev/control ]
}

sum() {
    sha256sum "$1" | cut -d ' ' -f 1
}

note() {
    grep -qxF -- "$1" "$made" || echo "$1" >>"$made"
}

# Makes a directory and those above it, and notes those that were not there.
directory() {
    if [ ! -d "$1" ]; then
        directory "$(dirname -- "$1")"
        mkdir -- "$1"
        note "d$tab$1"
    fi
}

# Writes stdin to a file with a mode. A file that was changed since this script wrote it, or that it did not write, stays.
put() {
    directory "$(dirname -- "$1")"
    cat >"$opt/new.tmp"
    if [ -e "$1" ] && [ "$(sum "$1")" != "$(sum "$opt/new.tmp")" ] && ! grep -qxF -- "f$tab$1$tab$(sum "$1")" "$made"; then
        echo "$1 was changed: it stays as it is."
    else
        install -m "$2" -- "$opt/new.tmp" "$1"
        grep -vF -- "f$tab$1$tab" "$made" >"$opt/list.tmp" || true
        mv -- "$opt/list.tmp" "$made"
        note "f$tab$1$tab$(sum "$1")"
    fi
    rm -f -- "$opt/new.tmp"
}

# Also without a running systemd, as in a chroot.
systemctl_here() {
    ! command -v systemctl >/dev/null || systemctl ${prefix:+"--root=$prefix"} --quiet "$@"
}

remove() {
    [ -f "$made" ] || fail "nothing is installed in $opt"
    ! has_systemd || systemctl stop 'car-*.timer' 'car-*.service' # each gateway stops its car first
    for each in "$units"/*.wants/car-*; do
        [ ! -L "$each" ] || systemctl_here disable "$(basename -- "$each")"
    done
    copy=$(mktemp)
    cp -- "$made" "$copy"
    rm -rf -- "$opt"
    while IFS=$tab read -r kind what first; do
        case $kind in
            f)
                if [ -e "$what" ] && [ "$(sum "$what")" != "$first" ]; then
                    echo "$what was changed: it stays."
                else
                    rm -f -- "$what"
                fi
                ;;
            u)
                # The next new user gets the same number, and must not own what stays.
                [ ! -d "$state" ] || chown -R root:root "$state"
                userdel "$what"
                ;;
        esac
    done <"$copy"
    # The deepest directories first. One that holds anything stays.
    sed -n "s/^d$tab//p" "$copy" | awk '{ print length($0) "\t" $0 }' | sort -rn | cut -f 2- | while read -r path; do
        [ ! -d "$path" ] || rmdir -- "$path" 2>/dev/null || echo "$path is not empty: it stays."
    done
    rm -f -- "$copy"
    if has_systemd; then
        systemctl daemon-reload
        ! has_udev || udevadm control --reload
    fi
    echo "Removed."
}

if [ -n "$uninstall" ]; then
    remove
    exit 0
fi

# ------------------------------------------------------------------ check before anything is made

[ -z "$car" ] || [ -n "$link" ] || fail "--car $car needs its --link" 2
[ -n "$car" ] || [ -z "$link$options" ] || fail "--link and --options need a --car" 2
case $car in
    *[!a-z0-9_-]* | [_-]*) fail "--car $car: allowed are a-z, 0-9, _ and -, beginning with a letter or digit" 2 ;;
esac
[ -z "$clone" ] || [ -f "$here/../pyproject.toml" ] || fail "--clone: this script is in no clone" 2
[ -z "$clone" ] || [ -z "$wheel" ] || fail "either --clone or --wheel" 2
[ -z "$wheel" ] || [ -f "$wheel" ] || fail "there is no $wheel" 2
python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || fail "it needs Python 3.11 or newer"
python3 -c 'import ensurepip, venv' 2>/dev/null || fail "it needs venv: sudo apt install python3-venv"

# ------------------------------------------------------------------ programs

umask 022
[ ! -d "$opt" ] || [ -f "$made" ] || fail "$opt is there, and this script has not made it"
above=''
[ -d "$prefix/opt" ] || above=yes
mkdir -p -- "$opt"
touch -- "$made"
[ -z "$above" ] || note "d$tab$prefix/opt"
note "d$tab$opt"
[ -x "$opt/bin/python" ] || python3 -m venv "$opt"
pip() {
    "$opt/bin/python" -m pip --disable-pip-version-check --no-input "$@"
}
if [ -n "$clone" ]; then
    # A build leaves files beside the sources.
    copy=$(mktemp -d)
    trap 'rm -rf -- "$copy"' EXIT
    for each in pyproject.toml README.md LICENSE fleet gateway schemas; do
        cp -R -- "$here/../$each" "$copy/"
    done
    pip wheel --quiet --no-deps --wheel-dir "$copy" "$copy"
    wheel=$(echo "$copy"/*.whl)
fi
what=${wheel:-$package}
if [ -n "$all" ]; then
    pip install --quiet --upgrade "${what}[secure,console,metrics,foxglove,mqtt]"
else
    # shellcheck disable=SC2086 # a list of words
    pip install --quiet --upgrade $needs ${ble:+"$needs_ble"}
    # A wheel of the same version, made anew, is another one.
    pip install --quiet --upgrade --no-deps ${wheel:+--force-reinstall} "$what"
fi

# ------------------------------------------------------------------ user, services, devices

if [ -z "$prefix" ]; then
    if ! id "$user" >/dev/null 2>&1; then
        useradd --system --home-dir "$state" --no-create-home --shell /usr/sbin/nologin "$user"
        note "u$tab$user"
    fi
    for group in dialout bluetooth; do
        ! getent group "$group" >/dev/null || usermod -a -G "$group" "$user"
    done
fi
directory "$state"
chmod 0700 "$state"
[ -n "$prefix" ] || chown -R "$user:$user" "$state" # after an --uninstall, the number of the user may be another one

put "$rules" 0644 <"$here/70-fleet-cars.rules"
put "$units/car-gateway@.service" 0644 <"$here/car-gateway@.service"
if [ -n "$all" ]; then
    for unit in car-hub.service car-hub-certificates.service car-hub-certificates.timer car-recorder.service \
        car-console.service car-exporter.service car-foxglove.service car-mqtt.service; do
        put "$units/$unit" 0644 <"$here/$unit"
    done
fi
directory "$config"
if [ -n "$car" ]; then
    printf 'LINK=%s\nPLATFORM=%s\nOPTIONS=%s\n' "$link" "$platform" "$options" | put "$config/$car.env" 0644
fi

if [ -n "$car" ]; then
    directory "$units/multi-user.target.wants"
    systemctl_here enable "car-gateway@$car.service"
fi

if has_systemd; then
    systemctl daemon-reload
    if has_udev; then
        udevadm control --reload
        udevadm trigger --subsystem-match=tty
    fi
    # What runs has the earlier programs. A gateway stops its car before it ends.
    systemctl try-restart --no-block 'car-*.service'
    [ -z "$car" ] || systemctl start --no-block "car-gateway@$car.service"
fi

as_user="sudo -u $user env -C $state FLEET_STATE_DIR=$state $opt/bin/fleet"
echo "Installed $("$opt/bin/gateway" --version), $(du -sm "$opt" | cut -f 1) MB in $opt."
if [ -n "$car" ]; then
    echo "The hub's computer invites it with: fleet hub invite --car $car"
    echo "Then join here:"
    echo "  $as_user join HOST CODE"
    echo "  sudo systemctl restart car-gateway@$car"
fi
if [ -n "$all" ]; then
    echo "For the hub's computer:"
    echo "  sudo systemctl enable --now car-hub-certificates.service car-hub-certificates.timer car-hub.service"
    echo "  sudo systemctl enable --now car-recorder.service car-console.service car-exporter.service"
    echo "Then let others join, and pair a device with the page:"
    echo "  $as_user hub invite NAME"
    echo "  $as_user console pair NAME"
fi
