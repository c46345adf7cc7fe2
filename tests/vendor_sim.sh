#!/usr/bin/env bash
# The first day (docs/first-day.md) at a simulator that the arm's vendor, or somebody else, wrote. ARM: ur, xarm or franka.
# Everything listens on 127.0.0.1 only, and ends with this script.
#
# Containers: universalrobots/ursim_cb3 and ursim_e-series (Universal Robots), danielwang123321/uf-ubuntu-docker
# (UFACTORY: "How to install UFACTORY Studio in Docker"). FR3: PyPI's franka-sim, which `make test-tools` installs.
set -euo pipefail
cd "$(dirname "$0")/.."
arm=${ARM:-} model=${MODEL:-} dimos=${DIMOS:-dimos}
report=${REPORT:-vendor-sim-$arm.day}

fail() { printf 'error: %s\nhint: %s\n' "$1" "$2" >&2; exit 1; }

# Ended by the identity that starting it gave.
container='' process=''
end() {
  [ -z "$container" ] || docker stop --time 5 "$container" >/dev/null || true
  [ -z "$process" ] || { exec 9>&-; wait "$process" || true; }
}
trap end EXIT

need_docker() {
  docker info >/dev/null 2>&1 || fail "no Docker daemon answers" "start Docker, or use ARM=franka, which needs none"
}

# PORT SECONDS WHAT
wait_for() {
  for ((waited = 0; waited < $2; waited++)); do
    if (: <>"/dev/tcp/127.0.0.1/$1") 2>/dev/null; then return; fi
    sleep 1
  done
  fail "$3 does not listen on port $1 after $2 s" "docker logs ${container:-of the container} says why"
}

# What the dashboard answers to COMMAND.
dashboard() {
  local greeting answer=''
  exec 8<>/dev/tcp/127.0.0.1/29999 || return 0
  read -r -t 3 greeting <&8 && printf '%s\n' "$1" >&8 && read -r -t 3 answer <&8 || true
  exec 8>&-
  printf '%s' "$answer"
}

publish() {
  for port in "$@"; do printf ' --publish 127.0.0.1:%s:%s' "$port" "$port"; done
}

case $arm in
ur)
  need_docker
  model=${model:-ur5} upper=${model^^}
  case $model in
  ur3 | ur5 | ur10) image=universalrobots/ursim_cb3 ;;
  ur3e | ur5e | ur10e | ur16e) image=universalrobots/ursim_e-series upper=${upper%E} ;;
  *) image=universalrobots/ursim_e-series ;;
  esac
  # shellcheck disable=SC2046
  container=$(docker run --rm --detach --env ROBOT_MODEL="$upper" $(publish 29999 30001 30002 30003 30004 6080) "$image")
  wait_for 29999 180 URSim
  wait_for 30004 180 URSim
  # The ports open before the controller is ready.
  for ((waited = 0; waited < 120; waited++)); do
    case $(dashboard robotmode) in *POWER_OFF* | *IDLE* | *RUNNING*) break ;; esac
    sleep 1
  done
  if [ "$image" = universalrobots/ursim_e-series ]; then
    echo "Open http://127.0.0.1:6080/vnc.html: Settings, System, Remote Control: Enable. Then Local at the top right: Remote Control."
    for ((waited = 0; waited < 600; waited++)); do
      case $(dashboard 'is in remote control') in *true*) break ;; esac
      sleep 1
    done
    case $(dashboard 'is in remote control') in
    *true*) ;;
    *) fail "URSim is not in remote control after 600 s" "select it at the simulated pendant, or use a CB3 arm: MODEL=ur5" ;;
    esac
  fi
  address=127.0.0.1 options=(--model "$model")
  ;;
xarm)
  need_docker
  model=${model:-xarm6}
  case $model in
  xarm5) kind=(5 5) ;; xarm6) kind=(6 6) ;; xarm7) kind=(7 7) ;; lite6) kind=(6 9) ;; xarm850) kind=(6 12) ;;
  *) fail "no xArm is called \"$model\"" "MODEL is xarm5, xarm6, xarm7, lite6 or xarm850" ;;
  esac
  # Its shell is what keeps the container alive, and ends without a terminal.
  # shellcheck disable=SC2046
  container=$(docker run --rm --detach --interactive --tty $(publish 502 503 504 30000 30001 30002 30003 18333) \
    danielwang123321/uf-ubuntu-docker /bin/bash)
  docker exec --detach --tty "$container" /xarm_scripts/xarm_start.sh "${kind[@]}"
  wait_for 502 120 "UFACTORY's firmware"
  wait_for 30003 120 "UFACTORY's firmware"
  sleep 20
  address=127.0.0.1 options=(--model "$model" --dof "${kind[0]}")
  ;;
franka)
  [ -z "$model" ] || [ "$model" = fr3 ] || fail "franka-sim is no $model" "leave MODEL out: it is an FR3"
  .venv/bin/python -c 'import franka_sim' 2>/dev/null || fail "franka-sim is not installed" "make test-tools"
  port=$(.venv/bin/python -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
  log=$(mktemp)
  # It ends with its standard input.
  exec 9> >(exec .venv/bin/python tests/python/franka_sim_server.py "$port" >"$log" 2>&1)
  process=$!
  for ((waited = 0; waited < 30; waited++)); do ! grep -q 'Server running' "$log" || break; sleep 1; done
  grep -q 'Server running' "$log" || fail "franka-sim does not start: $(tail -1 "$log")" "$log"
  address=127.0.0.1:$port options=()
  ;;
*) fail "ARM is \"$arm\"" "make vendor-sim ARM=ur, xarm or franka, with MODEL=ur10e, lite6 and the like" ;;
esac

"$dimos" adapter test "$arm" --address "$address" "${options[@]}" --first-day --yes --report "$report" "$@"
