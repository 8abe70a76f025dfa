#!/bin/bash
# vcan.sh COMMAND [ARG...]    runs COMMAND where a real SocketCAN interface vcan0 is up
# vcan.sh --check             exit status 0 if that is possible on this machine, else 125; prints nothing
#
# If the kernel has vcan, COMMAND runs in a new network namespace (without root, if user namespaces are allowed), or with a
# vcan0 that is up already. Otherwise the script boots a User Mode Linux guest: a whole kernel as an ordinary process, also
# without root. COMMAND is then root in the guest. It sees the host's files under the same paths, with the rights of the
# caller, and has the caller's environment and working directory; only /proc, /sys, /dev, /dev/shm and /run are the guest's.
# In a namespace or a guest the network has only lo, vcan0 and dummy0 (for multicast).
#
# stdout and stderr stay separate, stdin is empty. The exit status is COMMAND's, or 125 if there is no vcan.
# The guest ends with this script, even if the script is killed. There is no time limit: use `timeout 600 vcan.sh ...`.
#
# VCAN_MEM        memory of the guest in MiB (1024)
# VCAN_BACKEND    the ways to try, in this order ("native uml")
# Guest needs:    apt-get install user-mode-linux busybox-static iproute2; on CPUs with AMX also gcc (see vcan-xstate.c)
set -u
ulimit -c 0
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
[ $# -gt 0 ] || { sed -n '2,/^set/{/^#/s/^# \{0,1\}//p}' "$0" >&2; exit 125; }
if [ "$1" = --check ]; then        # really boots a guest (about a second), since only then a missing right shows
  bash "$0" true >/dev/null 2>&1; exit
fi

# The network, as a batch for ip(8), in a namespace and in the guest.
read -r -d '' network <<'END'
link set lo up
link add vcan0 type vcan
link set vcan0 up
link add dummy0 type dummy
link set dummy0 up multicast on
addr add 10.255.255.1/24 dev dummy0
route add 224.0.0.0/4 dev dummy0
END

native() {                         # does not return if it works
  local own=(unshare -n)
  [ "$(id -u)" = 0 ] || own=(unshare -rn)
  if "${own[@]}" ip link add vcan0 type vcan 2>/dev/null; then
    # net.core belongs to the host and is not changed; without dummy0 there is no multicast
    exec "${own[@]}" bash -c 'ip -force -batch - <<<"$1" 2>/dev/null; shift; exec "$@" </dev/null' - "$network" "$@"
  elif ip link show up dev vcan0 2>/dev/null | grep -q .; then
    exec "$@" </dev/null
  fi
}

guest_init() {                     # the guest's process 1: busybox runs all commands, since a fork takes 50 ms there
  cat <<END
#!$busybox sh
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
end() { sync; poweroff -f; sleep 9; }
# busybox runs its commands as /proc/self/exe; until the guest has its own /proc, this is the kernel itself
own() { $busybox mount -t \$1 -o \$3 \$1 /\$2 || { echo "no own /\$2"; end; }; }
own proc proc rw; own sysfs sys rw; own devtmpfs dev rw; own tmpfs run mode=755
mkdir -p /dev/pts /dev/shm; own devpts dev/pts mode=620,ptmxmode=666; own tmpfs dev/shm mode=1777
ln -sf /proc/self/fd /dev/fd; ln -sf fd/0 /dev/stdin; ln -sf fd/1 /dev/stdout; ln -sf fd/2 /dev/stderr
cd /usr/lib/uml/modules/*/kernel || end
for m in net/can/can net/can/can-raw net/can/can-bcm net/can/can-gw drivers/net/can/dev/can-dev drivers/net/can/vcan \\
  drivers/net/dummy; do insmod \$m.ko; done
for i in rmem_max rmem_default wmem_max; do echo 4194304 >/proc/sys/net/core/\$i; done     # buffers that hold a burst
$ip -force -batch "$dir/network"; [ -e /sys/class/net/vcan0 ] || { echo 'no vcan0 in the guest'; end; }
export MALLOC_MMAP_THRESHOLD_=268435456 MALLOC_TRIM_THRESHOLD_=2147483648   # page faults are slow: keep freed memory
stty -F /dev/tty1 raw -echo; stty -F /dev/tty2 raw -echo
mkfifo /run/out /run/err           # COMMAND gets pipes, not a terminal, so that its bytes arrive unchanged
cat /run/out >/dev/tty1 & out=\$!
cat /run/err >/dev/tty2 & err=\$!
: >"$dir/ready"
/bin/bash "$dir/command" </dev/null >/run/out 2>/run/err; status=\$?
for i in \$(seq 100); do kill -0 \$out 2>/dev/null || kill -0 \$err 2>/dev/null || break; sleep .05; done
stty -F /dev/tty1 raw; stty -F /dev/tty2 raw       # these wait until all output is sent
echo \$status >"$dir/status"; end
END
}

uml() {                            # does not return if the guest booted
  local kernel ip busybox dir memory pin preload='' pid sent
  kernel=$(command -v linux.uml) && ip=$(command -v ip) && busybox=$(command -v busybox) || return 1
  [ -d /usr/lib/uml/modules ] || return 1
  dir=$(mktemp -d "${TMPDIR:-/tmp}/vcan.XXXXXX") && dir=$(realpath "$dir") || return 1
  echo "$network" >"$dir/network"
  { export -p; printf 'cd %q || exit 126\nexec' "$PWD"; printf ' %q' "$@"; } >"$dir/command"
  guest_init >"$dir/init"; chmod +x "$dir/init"
  if grep -qm1 amx_tile /proc/cpuinfo; then
    preload=$dir/xstate.so
    cc -O2 -shared -fPIC -o "$preload" "$(dirname "$0")/vcan-xstate.c" >&2 || { rm -rf "$dir"; why='no cc, and AMX'; return 1; }
  fi
  # The kernel changes the modes of its terminal: give it pipes, not the caller's terminal.
  exec 3> >(exec cat); sent=$!; exec 4> >(exec cat >&2); sent+=" $!"
  # A system call of the guest is a switch between processes, which is faster on one CPU. The guest's memory is a file that
  # is mapped executable. The blacklisted calls are benchmarks of RAID code, which take 0.8 s at each boot.
  pin="taskset -c $((RANDOM % $(nproc)))"; $pin true 2>/dev/null || pin=
  memory=/dev/shm; findmnt -no OPTIONS -T $memory 2>/dev/null | grep -q noexec && memory=$dir
  env TMPDIR=$memory ${preload:+LD_PRELOAD="$preload"} setsid $pin "$kernel" mem="${VCAN_MEM:-1024}M" root=/dev/root rootfstype=hostfs rootflags=/ rw quiet \
    uml_dir="$dir" con=null con0=null,fd:2 con1=null,fd:3 con2=null,fd:4 devtmpfs.mount=0 init="$dir/init" \
    initcall_blacklist=raid6_select_algo,calibrate_xor_blocks,register_xor_blocks </dev/null >"$dir/log" 2>&1 &
  pid=$!
  # This process reads a pipe that only the script holds open. When the script ends, even by kill -9, the pipe closes, and the
  # process kills the guest and removes its files. It has its own session, so that Ctrl-C does not reach it.
  exec 5> >(exec setsid bash -c 'cat; kill -9 -- "-$1"; rm -rf "$2"' - "$pid" "$dir" 3>&- 4>&- >/dev/null 2>&1)
  exec 3>&- 4>&-
  trap 'exit 130' INT; trap 'exit 143' TERM HUP
  for _ in {1..600}; do [ ! -e "$dir/ready" ] && kill -0 "$pid" 2>/dev/null || break; sleep .05; done
  if [ ! -e "$dir/ready" ]; then
    why="the guest did not boot: $(grep -avm1 -e SELinux -e mmapper -e ubd "$dir/log" | tr -d '\r')"
    kill -9 -- "-$pid"; wait "$pid"; return 1
  fi 2>/dev/null
  wait "$pid" 2>/dev/null; kill -9 -- "-$pid" 2>/dev/null
  wait $sent
  [ -s "$dir/status" ] && exit "$(cat "$dir/status")"
  echo "vcan.sh: the guest died: $(tail -n 1 "$dir/log" | tr -d '\r')" >&2; exit 125
}

why='neither the kernel nor a guest'
for backend in ${VCAN_BACKEND:-native uml}; do "$backend" "$@"; done
echo "vcan.sh: no vcan0 here ($why); install: apt-get install user-mode-linux busybox-static iproute2 gcc libc6-dev" >&2
exit 125
