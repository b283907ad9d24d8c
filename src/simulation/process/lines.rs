//! Splits the output of a program into lines.

use crate::shared::text::one_line;

/// The incomplete last line of an output.
pub struct Lines {
    line: Vec<u8>,
    longest: usize,
}

impl Lines {
    /// For an output of whose lines so many bytes are kept; the rest of a longer one is left out.
    pub fn new(longest: usize) -> Self {
        Self { line: Vec::new(), longest }
    }

    /// Passes on each line that ends in these bytes, made printable; also lines that the program overwrites (`\r`).
    /// Empty lines are dropped.
    pub fn feed(&mut self, bytes: &[u8], mut told: impl FnMut(String)) {
        for byte in bytes {
            match byte {
                b'\r' | b'\n' => self.end(&mut told),
                _ if self.line.len() < self.longest => self.line.push(*byte),
                _ => {}
            }
        }
    }

    /// Passes on the line in which the output ended, if there is one.
    pub fn end(&mut self, mut told: impl FnMut(String)) {
        let text = one_line(String::from_utf8_lossy(&self.line).trim_end());
        self.line.clear();
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
            let (mut lines, mut told) = (Lines::new(50), Vec::new());
            bytes.chunks(size).for_each(|chunk| lines.feed(chunk, |line| told.push(line)));
            lines.end(|line| told.push(line));
            for line in &told {
                prop_assert!(!line.chars().any(char::is_control) && line.chars().count() <= 50, "{line:?}");
            }
            let breaks = bytes.split(|byte| b"\r\n".contains(byte)).count();
            prop_assert!(told.len() <= breaks, "{} lines of {breaks}", told.len());
        }
    }

    #[test]
    fn lines_come_whole_whatever_the_parts_they_are_read_in() {
        let text: &[u8] = b"Step 1/2 : FROM a\r\n\x1b[31mred\n\n10%\r20%\nlonger than it may be\nlast";
        for size in 1..text.len() {
            let (mut lines, mut told) = (Lines::new(17), Vec::new());
            text.chunks(size).for_each(|chunk| lines.feed(chunk, |line| told.push(line)));
            lines.end(|line| told.push(line));
            assert_eq!(told, ["Step 1/2 : FROM a", " [31mred", "10%", "20%", "longer than it ma", "last"]);
        }
    }
}
