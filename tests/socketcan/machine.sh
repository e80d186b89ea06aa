#!/usr/bin/env bash
# Runs a command in a small virtual machine with Debian's own kernel, which has SocketCAN:
#
#     tests/socketcan/machine.sh COMMAND...
#
# The machine sees this computer's files, read-only but for /run, and two virtual CAN buses, vcan0 and vcan1 (FD). No
# hardware virtualisation is needed. Exit code: the command's; 77 where the machine cannot be had; 99 when it
# ended without a word. MACHINE_DIR: where kernel and ramdisk are kept; MACHINE_TIMEOUT: seconds it may take.
set -euo pipefail

FOLDER=${MACHINE_DIR:-${TMPDIR:-/tmp}/mocap-socketcan-$(id -u)}
TIMEOUT=${MACHINE_TIMEOUT:-240}
TOOLS="qemu-system-x86_64=qemu-system-x86 busybox=busybox-static cpio=cpio depmod=kmod ip=iproute2"
MODULES="virtio_pci 9pnet_virtio 9p can can-raw can-dev vcan"
PATH=$PATH:/usr/sbin:/sbin

give_up() { echo "no machine for SocketCAN: $*" >&2; exit 77; }

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi
}

# What is missing is installed where apt may; otherwise it is said what is missing.
install_tools() {
    local missing="" tool
    for tool in $TOOLS; do
        command -v "${tool%%=*}" >/dev/null || missing="$missing ${tool##*=}"
    done
    [ -z "$missing" ] && return
    command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; } \
        || give_up "not installed, and may not be:$missing (apt install$missing)"
    echo "Installing$missing ..."
    # shellcheck disable=SC2086  # several words
    as_root apt-get update -qq && as_root env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends $missing >/dev/null \
        || give_up "could not be installed:$missing"
}

# The generic kernel (the cloud one has no CAN), unpacked and not installed.
fetch_kernel() {
    [ -e "$FOLDER/vmlinuz" ] && return
    local package
    package=$(apt-cache depends linux-image-amd64 2>/dev/null | awk '/Depends:/ {print $2; exit}')
    [ -n "$package" ] || give_up "apt knows no linux-image-amd64"
    (cd "$FOLDER" && apt-get download -qq "$package" 2>/dev/null) || give_up "$package cannot be downloaded"
    dpkg-deb --fsys-tarfile "$FOLDER/$package"_*.deb | tar -x -C "$FOLDER" --wildcards './boot/vmlinuz-*' \
        './lib/modules/*/kernel/net/can/*' './lib/modules/*/kernel/net/9p/*' \
        './lib/modules/*/kernel/fs/9p/*' './lib/modules/*/kernel/fs/netfs/*' \
        './lib/modules/*/kernel/fs/fscache/*' './lib/modules/*/kernel/drivers/net/can/*' \
        './lib/modules/*/kernel/drivers/virtio/*' './lib/modules/*/kernel/lib/*' './lib/modules/*/modules.*'
    rm -f "$FOLDER/$package"_*.deb
    depmod -b "$FOLDER" "$(ls "$FOLDER/lib/modules")"
    mv "$FOLDER"/boot/vmlinuz-* "$FOLDER/vmlinuz"
}

# Files of a module and of all that it needs, in order of loading.
files_of() {
    modprobe -S "$(ls "$FOLDER/lib/modules")" -d "$FOLDER" --show-depends "$1" 2>/dev/null \
        | awk '$1 == "insmod" {print $2}'
}

build_ramdisk() {
    local root=$1 command=$2 modules="" module file
    mkdir -p "$root"/{bin,modules,proc,sys,dev,host}
    cp "$(command -v busybox)" "$root/bin/busybox"
    for module in $MODULES; do
        for file in $(files_of "$module"); do
            case " $modules " in *" $(basename "$file") "*) continue ;; esac
            cp "$file" "$root/modules/"
            modules="$modules $(basename "$file")"
        done
    done
    printf '%s' "$command" > "$root/command"
    cat > "$root/init" <<INIT
#!/bin/busybox sh
B=/bin/busybox
\$B mount -t proc p /proc; \$B mount -t sysfs s /sys; \$B mount -t devtmpfs d /dev
for m in $modules; do \$B insmod /modules/\$m || echo "module \$m cannot be loaded"; done
\$B mount -t 9p -o trans=virtio,version=9p2000.L,msize=524288,cache=loose,ro host /host || \$B poweroff -f
\$B mount -t proc p /host/proc; \$B mount -t sysfs s /host/sys; \$B mount -t devtmpfs d /host/dev
\$B mkdir -p /dev/pts; \$B mount -t devpts x /host/dev/pts
\$B mount -t tmpfs t /host/run
\$B ip link set lo up
for i in 0 1; do
    \$B chroot /host $(command -v ip) link add dev vcan\$i type vcan
    \$B chroot /host $(command -v ip) link set vcan\$i mtu 72 up
done
\$B cp /command /host/run/command
echo "machine up after \$(\$B cut -d' ' -f1 /proc/uptime) s, Linux \$(\$B uname -r)"
\$B chroot /host /bin/bash -c 'cd "$PWD" && export HOME=/run TMPDIR=/run PYTHONDONTWRITEBYTECODE=1 && . /run/command'
echo "machine-exit \$?"
\$B poweroff -f
INIT
    chmod +x "$root/init"
    (cd "$root" && find . | cpio -o -H newc --quiet | gzip -1)
}

[ $# -gt 0 ] || { sed -n '2,9s/^# \{0,1\}//p' "$0"; exit 2; }
[ "$(uname -m)" = x86_64 ] || give_up "only x86-64 is catered for, this is $(uname -m)"
install_tools
mkdir -p "$FOLDER"
fetch_kernel
work=$(mktemp -d "$FOLDER/run.XXXXXX")
trap 'rm -rf "$work"' EXIT
build_ramdisk "$work/root" "$*" > "$work/ramdisk.gz"

timeout -k 5 "$TIMEOUT" qemu-system-x86_64 -accel tcg,thread=multi -cpu max -smp 1 -m 1024 -nographic \
    -no-reboot -nodefaults -serial stdio -monitor none -kernel "$FOLDER/vmlinuz" -initrd "$work/ramdisk.gz" \
    -append "console=ttyS0 quiet loglevel=3 panic=-1 tsc=reliable mitigations=off random.trust_cpu=on" \
    -fsdev local,id=h,path=/,security_model=none,readonly=on,multidevs=remap \
    -device virtio-9p-pci,fsdev=h,mount_tag=host </dev/null | tr -d '\r' | tee "$work/log" || true
code=$(sed -n 's/^machine-exit \([0-9]*\)$/\1/p' "$work/log" | tail -1)
exit "${code:-99}"
