# SPDX-License-Identifier: BSD-3-Clause
# Sourced by scripts/run and scripts/test: makes the machine and this checkout ready, from a bare Debian 12 on.
#
#   prepare run|test    installs what is missing, makes .venv, builds, and sources the devel space
#
# Each step first looks whether there is anything to do, so that the second time takes a second. On other systems it
# installs no system packages: it goes on when all is there, and else says what is missing.
# shellcheck shell=bash

set -euo pipefail

root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)"
venv="$root/.venv"
build="$root/build"
python="$venv/bin/python"
system_python=/usr/bin/python3  # rospy is the distribution's, so its Python it must be

fail() {
  echo "$(basename "$0"): $*" >&2
  exit 1
}

# quietly TITLE COMMAND...: runs a command; its output is shown only when it fails.
quietly() {
  local title="$1" log
  shift
  echo "-- $title" >&2
  log="$(mktemp)"
  if ! "$@" >"$log" 2>&1 </dev/null; then
    cat "$log" >&2
    rm -f "$log"
    fail "failed: $title"
  fi
  rm -f "$log"
}

# wanted_packages run|test: the Debian packages for that purpose, one a line.
wanted_packages() {
  local package purpose command
  while read -r package purpose command; do
    case "$package" in '' | '#'*) continue ;; esac
    [ "$purpose" = run ] || [ "$1" = test ] || continue
    [ -n "$command" ] && command -v "$command" >/dev/null && continue
    echo "$package"
  done <"$root/debian-packages.txt"
}

is_debian_12() {
  (. /etc/os-release 2>/dev/null && [ "${ID:-}" = debian ] && [ "${VERSION_ID:-}" = 12 ])
}

install_packages() {
  local wanted missing
  wanted="$(wanted_packages "$1")"
  # shellcheck disable=SC2016,SC2086  # dpkg's own variables; one word per package
  missing="$(comm -23 <(sort -u <<<"$wanted") \
    <(dpkg-query -W -f '${db:Status-Abbrev}${Package}\n' $wanted 2>/dev/null | sed -n 's/^ii *//p' | sort -u))"
  [ -z "$missing" ] && return
  local -a as_root=()
  if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null || fail "these Debian packages are missing, and there is neither root nor sudo to" \
      "install them: $(echo $missing)"
    as_root=(sudo)
  fi
  quietly "apt-get update" "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get update
  quietly "apt-get install $(echo $missing)" "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
    apt-get install -y --no-install-recommends $missing
}

# On systems other than Debian 12: everything that the packages would have brought must be there.
check_system() {
  local -a missing=() commands=(cmake make c++ roslaunch rosmaster rosrun rospack rosmsg)
  local -a modules=(venv catkin_pkg genpy rospy roslaunch rosgraph std_msgs geometry_msgs)
  if [ "$1" = test ]; then
    commands+=(rostest node npm)
    modules+=(rostest actionlib)
  fi
  local name
  for name in "${commands[@]}"; do
    command -v "$name" >/dev/null || missing+=("the command $name")
  done
  [ -x "$system_python" ] || missing+=("$system_python")
  for name in "${modules[@]}"; do
    "$system_python" -c "import $name" 2>/dev/null || missing+=("$system_python's module $name")
  done
  [ "${#missing[@]}" -eq 0 ] && return
  fail "this is not Debian 12, where it installs what it needs by itself. Here you must install it, and source the" \
    "setup.bash of ROS; missing: $(printf '%s, ' "${missing[@]}" | sed 's/, $//')"
}

# unchanged STAMP TEXT: whether a step was done for just this text before.
unchanged() {
  [ -f "$1" ] && [ "$(cat "$1")" = "$2" ]
}

make_venv() {
  local state
  state="$("$system_python" -V) $(sha256sum <"$root/requirements.txt")"
  unchanged "$venv/.requirements" "$state" && "$python" -c '' 2>/dev/null && return
  quietly "Python environment in .venv" "$system_python" -m venv --clear --system-site-packages "$venv"
  quietly "Python packages of requirements.txt" \
    "$python" -m pip install --disable-pip-version-check --no-input -r "$root/requirements.txt"
  echo "$state" >"$venv/.requirements"
}

build_packages() {
  local state="$root $python"
  if ! unchanged "$build/.configured" "$state"; then
    grep -qsx "CMAKE_HOME_DIRECTORY:INTERNAL=$root" "$build/CMakeCache.txt" || rm -rf "$build"  # moved, or none
    quietly "cmake: configure" cmake -S "$root" -B "$build" -DPYTHON_EXECUTABLE="$python"
    echo "$state" >"$build/.configured"
  fi
  quietly "cmake: build" cmake --build "$build" --parallel "$(nproc)"
}

source_devel_space() {
  set +u  # catkin's files use variables that may be unset
  # shellcheck disable=SC1091
  source "$build/devel/setup.bash"
  set -u
}

prepare() {
  if is_debian_12; then
    install_packages "$1"
  else
    check_system "$1"
  fi
  make_venv
  build_packages
  source_devel_space
}
