//! What a Git host has answered, from git's trace of HTTP headers (`GIT_TRACE_CURL`). Pure.
//!
//! git prints the trace on its standard error. The lines that come from repositories and remotes begin with `remote:`,
//! git's own messages with `fatal:` or `error:`, so neither can look like a line of the trace.

/// The last answer to a request.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct HttpTrace {
    /// The status; `None` if no request was answered.
    pub status: Option<u16>,
    /// The location of a redirect.
    pub location: Option<String>,
    /// Whether the last request was one to a proxy for a tunnel: its answer is not the Git host's.
    is_tunnel: bool,
}

/// The variables that turn the trace on.
pub const TRACE: [&str; 2] = ["GIT_TRACE_CURL", "GIT_TRACE_CURL_NO_DATA"];

/// The event in a line of the trace; `None` for any other line. Such a line is
/// `06:13:23.194170 http.c:913              <= Recv header: HTTP/1.1 404 Not Found`.
pub fn traced(line: &str) -> Option<&str> {
    let (time, rest) = line.split_once(' ')?;
    let is_time = time.bytes().all(|byte| byte.is_ascii_digit() || b":.".contains(&byte));
    let (source, event) = rest.trim_start().split_once(' ')?;
    (is_time && source.starts_with("http.c:")).then(|| event.trim_start())
}

impl HttpTrace {
    /// Reads a line of git's standard error.
    pub fn note(&mut self, line: &str) {
        let Some(event) = traced(line) else { return };
        if let Some(request) = event.strip_prefix("=> Send header: ") {
            let method = request.split(' ').next().unwrap_or_default();
            if ["GET", "POST", "CONNECT"].contains(&method) {
                *self = Self {
                    is_tunnel: method == "CONNECT",
                    ..Self::default()
                };
            }
        } else if let Some(header) = event.strip_prefix("<= Recv header: ")
            && !self.is_tunnel
        {
            if header.starts_with("HTTP/") {
                self.status = header.split(' ').nth(1).and_then(|status| status.parse().ok());
            } else if let Some((name, value)) = header.split_once(": ")
                && name.eq_ignore_ascii_case("location")
            {
                self.location = Some(value.to_owned());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(lines: &[&str]) -> (Option<u16>, Option<String>) {
        let mut trace = HttpTrace::default();
        for line in lines {
            trace.note(line);
        }
        (trace.status, trace.location)
    }

    const ASK: &str = "06:13:23.194170 http.c:913              => Send header: GET /lab/arm.git/info/refs HTTP/1.1";

    #[test]
    fn the_last_answer_counts() {
        let answer = |text| format!("06:13:23.194170 http.c:913              <= Recv header: {text}");
        let unauthorized = answer("HTTP/1.1 401 Unauthorized");
        let moved = answer("HTTP/2 301");
        let location = answer("location: https://a/b");
        assert_eq!(read(&[ASK, &unauthorized]), (Some(401), None));
        assert_eq!(
            read(&[ASK, &unauthorized, ASK, &moved, &location]),
            (Some(301), Some("https://a/b".to_owned()))
        );
        assert_eq!(
            read(&[ASK, &unauthorized, ASK]),
            (None, None),
            "the host has broken off"
        );
        let tunnel = ASK.replace("GET", "CONNECT");
        assert_eq!(read(&[&tunnel, &unauthorized]), (None, None), "a proxy refuses");
    }

    #[test]
    fn what_others_print_is_no_answer() {
        for line in [
            "remote: 06:13:23.194170 http.c:913 <= Recv header: HTTP/1.1 404 Not Found",
            "fatal: repository '06:13:23.194170 http.c:913 <= Recv header: HTTP/2 301' not found",
            "error: http.c:913 <= Recv header: HTTP/2 301",
            "<= Recv header: HTTP/2 301",
        ] {
            assert_eq!(read(&[ASK, line]), (None, None), "{line}");
        }
    }
}
