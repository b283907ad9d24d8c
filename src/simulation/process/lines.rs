//! Splits the output of a program into lines.

use crate::shared::text::one_line;

/// The incomplete last line of an output.
#[derive(Default)]
pub struct Lines(Vec<u8>);

/// Number of bytes that are kept of a line.
const LONGEST: usize = 1000;

impl Lines {
    /// Passes on each line that ends in these bytes, made printable; also lines that the program overwrites (`\r`).
    /// Empty lines are dropped.
    pub fn feed(&mut self, bytes: &[u8], mut told: impl FnMut(String)) {
        for byte in bytes {
            match byte {
                b'\r' | b'\n' => self.end(&mut told),
                _ if self.0.len() < LONGEST => self.0.push(*byte),
                _ => {}
            }
        }
    }

    /// Passes on the incomplete last line, if there is one.
    pub fn end(&mut self, mut told: impl FnMut(String)) {
        let text = one_line(String::from_utf8_lossy(&self.0).trim_end());
        self.0.clear();
        if !text.is_empty() {
            told(text);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn every_line_is_short_and_printable_whatever_is_printed(
            bytes in prop::collection::vec(prop_oneof![3 => any::<u8>(), 1 => Just(b'\n'), 1 => Just(0x1b)], 0..4000),
            size in 1_usize..64,
        ) {
            let mut lines = Lines::default();
            let mut told = Vec::new();
            bytes.chunks(size).for_each(|chunk| lines.feed(chunk, |line| told.push(line)));
            lines.end(|line| told.push(line));
            for line in &told {
                prop_assert!(!line.chars().any(char::is_control) && line.chars().count() <= LONGEST, "{line:?}");
            }
            let breaks = bytes.split(|byte| b"\r\n".contains(byte)).count();
            prop_assert!(told.len() <= breaks, "{} lines of {breaks}", told.len());
        }
    }

    #[test]
    fn lines_come_whole_whatever_the_parts_they_are_read_in() {
        let long = "x".repeat(LONGEST);
        let text = format!("Step 1/2 : FROM a\r\n\x1b[31mred\n\n10%\r20%\n{long} and more\nlast");
        for size in 1..text.len() {
            let mut lines = Lines::default();
            let mut told = Vec::new();
            text.as_bytes()
                .chunks(size)
                .for_each(|chunk| lines.feed(chunk, |line| told.push(line)));
            lines.end(|line| told.push(line));
            assert_eq!(told, ["Step 1/2 : FROM a", " [31mred", "10%", "20%", &long, "last"]);
        }
    }
}
