//! The system call filter of each sandbox. It refuses what gives a program more of the kernel than a simulation needs:
//! what Docker's default profile refuses to a container without capabilities, as its documentation lists
//! (<https://docs.docker.com/engine/security/seccomp/>), and `io_uring`. Unlike that profile it lets programs debug
//! each other and choose their memory's NUMA nodes, which reaches nothing outside of the sandbox.
//!
//! Calls that are newer than this list fail as on an older kernel, which programs expect.

use std::str::FromStr;

use syscalls::{aarch64, arm, x86, x86_64};

/// Calls that fail with `EPERM`.
const REFUSED: &str = "\
    acct bpf clock_adjtime clock_adjtime64 clock_settime clock_settime64 create_module delete_module fanotify_init \
    finit_module get_kernel_syms init_module ioperm iopl kcmp kexec_file_load kexec_load lookup_dcookie nfsservctl \
    open_by_handle_at perf_event_open pidfd_getfd query_module quotactl quotactl_fd reboot setns settimeofday stime swapoff \
    swapon sysfs _sysctl syslog unshare uselib userfaultfd ustat vhangup vm86 vm86old \
    add_key keyctl request_key \
    io_uring_enter io_uring_register io_uring_setup \
    fsconfig fsmount fsopen fspick mount mount_setattr move_mount open_tree open_tree_attr pivot_root umount umount2 \
    socketcall";
/// Flags of `clone` that create namespaces.
const NEW_NAMESPACES: u32 = 0x7e02_0000;
/// The family of sockets (`AF_VSOCK`) that reach the host of a virtual machine.
const VSOCK: u32 = 40;

/// An architecture that a program may use.
struct Architecture {
    /// The kernel's number of it (`AUDIT_ARCH_...`).
    number: u32,
    /// The number of a call, if it has one of this name.
    find: fn(&str) -> Option<i32>,
    /// The number from which on calls are unknown.
    unknown: u32,
}

/// x86 and ARM, 64 and 32 bits. 64-bit x86 includes x32, whose numbers are all unknown.
fn architectures() -> [Architecture; 4] {
    let above = |last: i32| last.unsigned_abs() + 1;
    [
        Architecture {
            number: 0xc000_003e,
            find: |name| x86_64::Sysno::from_str(name).ok().map(|call| call.id()),
            unknown: above(x86_64::Sysno::last().id()),
        },
        Architecture {
            number: 0x4000_0003,
            find: |name| x86::Sysno::from_str(name).ok().map(|call| call.id()),
            unknown: above(x86::Sysno::last().id()),
        },
        Architecture {
            number: 0xc000_00b7,
            find: |name| aarch64::Sysno::from_str(name).ok().map(|call| call.id()),
            unknown: above(aarch64::Sysno::last().id()),
        },
        Architecture {
            number: 0x4000_0028,
            find: |name| arm::Sysno::from_str(name).ok().map(|call| call.id()),
            // Its private calls have high numbers.
            unknown: u32::MAX,
        },
    ]
}

/// An instruction of classic BPF: code, jumps if true and if false, value.
type Instruction = (u16, u8, u8, u32);

/// Codes of instructions: load a word of the call's data, jump, return.
const LOAD: u16 = 0x20;
const JUMP: u16 = 0x05;
const IF_EQUAL: u16 = 0x15;
const IF_AT_LEAST: u16 = 0x35;
const IF_ANY_BIT: u16 = 0x45;
const GIVE: u16 = 0x06;
/// The call is made.
const ALLOW: Instruction = (GIVE, 0, 0, 0x7fff_0000);
/// The call fails with `EPERM`.
const REFUSE: Instruction = (GIVE, 0, 0, 0x0005_0001);
/// The call fails with `ENOSYS`, as if the kernel did not have it.
const NOT_THERE: Instruction = (GIVE, 0, 0, 0x0005_0026);
/// Places in the call's data: its number, its architecture, and the low half of its first argument.
const NUMBER: u32 = 0;
const ARCHITECTURE: u32 = 4;
const ARGUMENT: u32 = 16;

impl Architecture {
    /// The instructions for calls of this architecture. Each path through them ends with a result.
    fn rules(&self) -> Vec<Instruction> {
        let mut rules = vec![(LOAD, 0, 0, NUMBER), (IF_AT_LEAST, 0, 1, self.unknown), NOT_THERE];
        let number = |name: &str| (self.find)(name).map(i32::unsigned_abs);
        for number in REFUSED.split_whitespace().filter_map(number) {
            rules.extend([(IF_EQUAL, 0, 1, number), REFUSE]);
        }
        if let Some(clone3) = number("clone3") {
            // A filter can't see its flags. Programs use `clone` instead.
            rules.extend([(IF_EQUAL, 0, 1, clone3), NOT_THERE]);
        }
        for (name, is_refused, value) in [("clone", IF_ANY_BIT, NEW_NAMESPACES), ("socket", IF_EQUAL, VSOCK)] {
            if let Some(number) = number(name) {
                rules.extend([(IF_EQUAL, 0, 4, number), (LOAD, 0, 0, ARGUMENT)]);
                rules.extend([(is_refused, 0, 1, value), REFUSE, ALLOW]);
            }
        }
        rules.push(ALLOW);
        rules
    }
}

/// The filter as bubblewrap's option `--seccomp` reads it, see `man 2 seccomp`.
pub fn filter() -> Vec<u8> {
    let of_architecture = |architecture: Architecture| {
        let rules = architecture.rules();
        let length = u32::try_from(rules.len()).unwrap_or(u32::MAX);
        let begin = [
            (LOAD, 0, 0, ARCHITECTURE),
            (IF_EQUAL, 1, 0, architecture.number),
            // To the next architecture.
            (JUMP, 0, 0, length),
        ];
        begin.into_iter().chain(rules)
    };
    let all = architectures().into_iter().flat_map(of_architecture).chain([ALLOW]);
    all.flat_map(|(code, yes, no, value)| {
        let [first, second] = code.to_ne_bytes();
        let [a, b, c, d] = value.to_ne_bytes();
        [first, second, yes, no, a, b, c, d]
    })
    .collect()
}
