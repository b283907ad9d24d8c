//! The system call filter of each sandbox. It refuses what gives a program more of the kernel than a simulation needs:
//! what Docker's default profile refuses to a container without capabilities, in version `seccomp/v0.2.3`
//! (<https://github.com/moby/profiles/blob/seccomp/v0.2.3/seccomp/default.json>), and also `clock_adjtime`, and 32-bit
//! programs' `socketcall`, whose arguments a filter can't see.
//!
//! Unlike that profile, which lists what is allowed, this one lists what is refused. So these are open: calls with which
//! programs debug each other (`process_madvise`, `process_vm_*`, `ptrace`) and choose their memory's NUMA nodes
//! (`mbind`, `set_mempolicy`, `move_pages` and others), which reach nothing outside of the sandbox; and calls that Linux
//! never had, that newer ones replace (`sigaction`, `oldstat` and others), or that are newer than the profile
//! (`file_getattr`).
//!
//! Calls that are newer than the crate `syscalls` fail as on an older kernel, which programs expect.

use std::str::FromStr;

use syscalls::{aarch64, arm, x86, x86_64};

/// Calls that fail with `EPERM`.
const REFUSED: &str = "\
    acct bpf chroot clock_adjtime clock_adjtime64 clock_settime clock_settime64 create_module delete_module \
    fanotify_init finit_module get_kernel_syms init_module ioperm iopl kcmp kexec_file_load kexec_load lookup_dcookie \
    lsm_get_self_attr lsm_list_modules lsm_set_self_attr nfsservctl open_by_handle_at perf_event_open pidfd_getfd \
    query_module quotactl quotactl_fd reboot setdomainname sethostname setns settimeofday stime swapoff swapon sysfs \
    _sysctl syslog unshare uselib userfaultfd ustat vhangup vm86 vm86old \
    add_key keyctl request_key \
    io_uring_enter io_uring_register io_uring_setup \
    fsconfig fsmount fsopen fspick mount mount_setattr move_mount open_tree open_tree_attr pivot_root umount umount2 \
    socketcall";
/// Flags of `clone` that create namespaces.
const NEW_NAMESPACES: u32 = 0x7e02_0000;
/// Families of sockets that reach the kernel's ciphers (`AF_ALG`) and the host of a virtual machine (`AF_VSOCK`).
const REFUSED_SOCKETS: [u32; 2] = [38, 40];
/// What `personality` may set: Linux (`PER_LINUX`, `PER_LINUX32`), also with an old version number (`UNAME26`), or
/// nothing, to read it. Others switch protections off, such as random addresses.
const PERSONALITIES: [u32; 5] = [0, 8, 0x2_0000, 0x2_0008, u32::MAX];

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
        for (name, is_it, values, then, otherwise) in [
            ("clone", IF_ANY_BIT, &[NEW_NAMESPACES][..], REFUSE, ALLOW),
            ("socket", IF_EQUAL, &REFUSED_SOCKETS, REFUSE, ALLOW),
            ("personality", IF_EQUAL, &PERSONALITIES, ALLOW, REFUSE),
        ] {
            if let Some(number) = number(name) {
                // All after the load are skipped for other calls.
                let length = values.iter().fold(2, |length, _| length + 2);
                rules.extend([(IF_EQUAL, 0, length, number), (LOAD, 0, 0, ARGUMENT)]);
                rules.extend(values.iter().flat_map(|value| [(is_it, 0, 1, *value), then]));
                rules.push(otherwise);
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

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    const ALLOWED: u32 = ALLOW.3;
    const REFUSED_WITH: u32 = REFUSE.3;

    /// What the filter does with a call, as the kernel runs it.
    fn outcome(architecture: u32, number: u32, argument: u32) -> u32 {
        let filter = filter();
        let (rules, rest) = filter.as_chunks::<8>();
        assert!(rest.is_empty() && rules.len() <= 4096, "the kernel takes no more");
        let (mut place, mut loaded) = (0, 0);
        loop {
            let [c0, c1, yes, no, v0, v1, v2, v3] = rules[place];
            let value = u32::from_ne_bytes([v0, v1, v2, v3]);
            let jump = |is_true: bool| usize::from(if is_true { yes } else { no });
            place += 1 + match u16::from_ne_bytes([c0, c1]) {
                LOAD => {
                    loaded = match value {
                        NUMBER => number,
                        ARCHITECTURE => architecture,
                        _ => argument,
                    };
                    0
                }
                JUMP => value as usize,
                IF_EQUAL => jump(loaded == value),
                IF_AT_LEAST => jump(loaded >= value),
                IF_ANY_BIT => jump(loaded & value != 0),
                _ => return value,
            };
        }
    }

    #[test]
    fn calls_are_refused_by_name_and_argument_on_each_architecture() {
        let mut found = BTreeSet::new();
        for Architecture { number, find, unknown } in architectures() {
            let of = |name: &str, argument| Some(outcome(number, find(name)?.unsigned_abs(), argument));
            for name in REFUSED.split_whitespace() {
                if let Some(outcome) = of(name, 0) {
                    assert_eq!(outcome, REFUSED_WITH, "{name} on {number:x}");
                    found.insert(name);
                }
            }
            for name in [
                "read",
                "execve",
                "futex",
                "ptrace",
                "mbind",
                "process_vm_readv",
                "exit_group",
            ] {
                assert_eq!(of(name, 0), Some(ALLOWED), "{name} on {number:x}");
            }
            for (name, argument, expected) in [
                // A thread, as the C library starts it, and namespaces: of users, and of the network.
                ("clone", 0x003d_0f00, ALLOWED),
                ("clone", 0x1000_0011, REFUSED_WITH),
                ("clone", 0x4000_0000, REFUSED_WITH),
                ("clone3", 0, NOT_THERE.3),
                // AF_INET, AF_NETLINK, AF_ALG, AF_VSOCK.
                ("socket", 2, ALLOWED),
                ("socket", 16, ALLOWED),
                ("socket", 38, REFUSED_WITH),
                ("socket", 40, REFUSED_WITH),
                ("personality", 0, ALLOWED),
                ("personality", 8, ALLOWED),
                ("personality", u32::MAX, ALLOWED),
                // ADDR_NO_RANDOMIZE, READ_IMPLIES_EXEC, MMAP_PAGE_ZERO.
                ("personality", 0x0004_0000, REFUSED_WITH),
                ("personality", 0x0040_0000, REFUSED_WITH),
                ("personality", 0x0010_0000, REFUSED_WITH),
            ] {
                assert_eq!(of(name, argument), Some(expected), "{name} {argument:x} on {number:x}");
            }
            if unknown < u32::MAX {
                assert_eq!(outcome(number, unknown, 0), NOT_THERE.3);
            }
        }
        let misspelt: Vec<&str> = REFUSED
            .split_whitespace()
            .filter(|name| !found.contains(name))
            .collect();
        assert_eq!(misspelt, [""; 0]);
    }
}
