//! The system call filter of each sandbox: it allows all calls except those for keyrings.
//!
//! Keyrings belong to sessions and users, and no namespace isolates them: all simulations would share the keyring of
//! the session in which the server was started. A new keyring for each would count towards the user's quota of 200 keys
//! (`kernel.keys.maxkeys`). Docker's filter refuses these calls too.

/// The architectures that a program may use (x86 and ARM, 64 and 32 bits): the kernel's number of each, and the number
/// of `add_key`, which `request_key` and `keyctl` follow.
const ARCHITECTURES: [(u32, u32); 4] = [
    (0xc000_003e, 248),
    (0x4000_0003, 286),
    (0xc000_00b7, 217),
    (0x4000_0028, 309),
];
/// Mask without the bit that distinguishes calls by the x32 ABI from those of 64-bit x86.
const NUMBER: u32 = 0x3fff_ffff;
/// Results of a filter: the call is made, or fails with `EPERM`.
const ALLOW: u32 = 0x7fff_0000;
const REFUSE: u32 = 0x0005_0001;

/// The filter as bubblewrap's option `--seccomp` reads it: instructions of classic BPF, see `man 2 seccomp`.
pub fn filter() -> Vec<u8> {
    let (load, and, subtract, if_equal, if_at_least, give) = (0x20, 0x54, 0x14, 0x15, 0x35, 0x06);
    let of_architecture = |(architecture, first)| {
        [
            // In the call's data, the architecture is at 4 and the number at 0.
            (load, 0, 0, 4),
            // If it differs, skip six instructions, to the next block.
            (if_equal, 0, 6, architecture),
            (load, 0, 0, 0),
            (and, 0, 0, NUMBER),
            (subtract, 0, 0, first),
            (if_at_least, 1, 0, 3),
            (give, 0, 0, REFUSE),
            (give, 0, 0, ALLOW),
        ]
    };
    let all = ARCHITECTURES
        .into_iter()
        .flat_map(of_architecture)
        .chain([(give, 0, 0, ALLOW)]);
    all.flat_map(|(code, yes, no, value): (u16, u8, u8, u32)| {
        let [first, second] = code.to_ne_bytes();
        let [a, b, c, d] = value.to_ne_bytes();
        [first, second, yes, no, a, b, c, d]
    })
    .collect()
}
