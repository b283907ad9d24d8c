//! Rules of web servers: ours, and those of the original documents.

use super::web_server::Kind;

/// A set of rules, adapted to a test's machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rules {
    /// `deploy/apache.conf`
    Apache,
    /// The same, with a signed-in user.
    ApacheWithUsers,
    /// `deploy/nginx.conf`
    Nginx,
    /// The same with `deploy/nginx-users.conf`, and oauth2-proxy on this port.
    NginxWithUsers(u16),
    /// `deploy/nginx-door.conf`: one nginx in front of machines whose servers have the same port.
    Door,
    /// The original documents' rules for a machine with a session server: every port of the machine, and three pages.
    Documents,
}

/// The values that differ between machines.
pub struct Place<'a> {
    /// Of the web server.
    pub http: u16,
    pub https: u16,
    pub session: u16,
    /// Ports of the fleet on this machine.
    pub here: &'a [u16],
    /// Ports of the fleet on the other machine, which is 127.0.0.2.
    pub there: &'a [u16],
    pub chain: &'a str,
    pub key: &'a str,
}

impl Rules {
    pub fn kind(self) -> Kind {
        if matches!(self, Self::Apache | Self::ApacheWithUsers | Self::Documents) {
            Kind::Apache
        } else {
            Kind::Nginx
        }
    }

    /// Whether all machines are behind one nginx on another machine.
    pub fn is_door(self) -> bool {
        self == Self::Door
    }

    /// The addresses of the machines. Without a door, the first is also the web server's.
    pub fn machines(self) -> [&'static str; 2] {
        if self.is_door() {
            ["127.0.0.2", "127.0.0.3"]
        } else {
            ["127.0.0.1", "127.0.0.2"]
        }
    }

    /// The path at which clients reach the session server.
    pub fn session_path(self, session: u16, path: &str) -> String {
        match self {
            Self::Documents => format!("/{session}{path}"),
            _ => path.to_owned(),
        }
    }

    pub fn text(self, place: &Place) -> String {
        let Place {
            http,
            https,
            session,
            here,
            there,
            chain,
            key,
        } = place;
        let pattern = |ports: &[u16]| ports.iter().map(u16::to_string).collect::<Vec<_>>().join("|");
        let editors = |ports: &[u16]| pattern(&ports[1..].iter().map(|port| port + 500).collect::<Vec<_>>());
        // Webots and editors of both machines, and the address of the other machine.
        let machines: [(&str, &str); 5] = [
            ("200[1-9]|201[0-9]|2020", &pattern(&here[1..])),
            ("300[1-9]|301[0-9]|3020", &pattern(&there[1..])),
            ("250[1-9]|251[0-9]|2520", &editors(here)),
            ("350[1-9]|351[0-9]|3520", &editors(there)),
            ("192.0.2.3", "127.0.0.2"),
        ];
        let any_address = |port: &str| format!("listen [::]:{port};\n");
        // Common to the nginx examples for a public host.
        let site = |text: &str, own: &[(&str, &str)]| {
            let shared: [(&str, &str); 7] = [
                ("/etc/letsencrypt/live/fleet.example.org/fullchain.pem", chain),
                ("/etc/letsencrypt/live/fleet.example.org/privkey.pem", key),
                ("fleet.example.org", "localhost"),
                (&any_address("80"), "\n"),
                (&any_address("443 ssl"), "\n"),
                ("listen 80;", &format!("listen 127.0.0.1:{http};")),
                ("listen 443 ssl;", &format!("listen 127.0.0.1:{https} ssl;")),
            ];
            adapt(&adapt(text, own), &shared)
        };
        match self {
            Self::Apache => {
                let own: [(&str, &str); 11] = [
                    // First, as other numbers may hold this one.
                    ("1999", &session.to_string()),
                    ("  #Rewrite", "  Rewrite"),
                    ("fleet.example.org", "localhost"),
                    ("*:80>", &format!("127.0.0.1:{http}>")),
                    ("*:443>", &format!("127.0.0.1:{https}>")),
                    ("/etc/letsencrypt/live/${FLEET_HOST}/fullchain.pem", chain),
                    ("/etc/letsencrypt/live/${FLEET_HOST}/privkey.pem", key),
                    ("^/2000/", &format!("^/{}/", here[0])),
                    ("127.0.0.1:2000/", &format!("127.0.0.1:{}/", here[0])),
                    ("^/3000/", &format!("^/{}/", there[0])),
                    ("192.0.2.3:3000/", &format!("192.0.2.3:{}/", there[0])),
                ];
                adapt(&adapt(include_str!("../../deploy/apache.conf"), &own), &machines)
            }
            Self::ApacheWithUsers => {
                let last = "  RequestHeader unset X-Forwarded-User early\n";
                let user = "  RequestHeader set X-Forwarded-User anna@lab.example\n";
                adapt(&Self::Apache.text(place), &[(last, &format!("{last}{user}"))])
            }
            Self::NginxWithUsers(port) => {
                let changes = [
                    ("4180", port.to_string()),
                    ("2000|3000", format!("{}|{}", here[0], there[0])),
                ];
                let changes = changes.each_ref().map(|(from, to)| (*from, to.as_str()));
                let users = adapt(include_str!("../../deploy/nginx-users.conf"), &changes);
                let last = "\n  proxy_set_header Forwarded \"\";\n";
                adapt(&Self::Nginx.text(place), &[(last, &format!("{last}{users}"))])
            }
            Self::Nginx => {
                let own: [(&str, &str); 6] = [
                    // First, as other numbers may hold this one.
                    ("1999", &session.to_string()),
                    ("  #location", "  location"),
                    ("  #  ", "    "),
                    ("  #}", "  }"),
                    ("  2000   127.0.0.1:2000;", &format!("  {0} 127.0.0.1:{0};", here[0])),
                    ("  #3000  192.0.2.3:3000;", &format!("  {0} 192.0.2.3:{0};", there[0])),
                ];
                site(include_str!("../../deploy/nginx.conf"), &[&own[..], &machines].concat())
            }
            Self::Door => site(
                include_str!("../../deploy/nginx-door.conf"),
                &[
                    ("192\\.0\\.2\\.[0-9]+", "127\\.0\\.0\\.[23]"),
                    ("192.0.2.1:1999", &format!("127.0.0.1:{session}")),
                    ("(?<fleet_port>2000)", &format!("(?<fleet_port>{})", here[0])),
                    machines[0],
                ],
            ),
            Self::Documents => {
                let rules = DOCUMENTS_HTTPS.replace("1999", &session.to_string());
                let there = pattern(there);
                format!(
                    "<VirtualHost 127.0.0.1:{http}>\nServerName localhost\nServerAlias www.localhost\n\
                     Redirect \"/\" \"https://localhost/\"\n</VirtualHost>\n\
                     <VirtualHost 127.0.0.1:{https}>\nServerName localhost\nServerAlias www.localhost\n\
                     SSLEngine on\nSSLCertificateFile {chain}\nSSLCertificateKeyFile {key}\n\
                     RewriteEngine on\n\
                     RewriteCond %{{HTTP:Upgrade}} websocket [NC]\n\
                     RewriteCond %{{HTTP:Connection}} upgrade [NC]\n\
                     RewriteRule ^/({there})/(.*)$ \"ws://127.0.0.2:$1/$2\" [P,L]\n\
                     RewriteRule ^/({there})/(.*)$ \"http://127.0.0.2:$1/$2\" [P,L]\n\
                     {rules}</VirtualHost>\n"
                )
            }
        }
    }
}

/// Replaces each of these words in a text, which must contain all of them.
pub fn adapt(text: &str, changes: &[(&str, &str)]) -> String {
    changes.iter().fold(text.to_owned(), |text, (from, to)| {
        assert!(text.contains(from), "{from:?} is not in\n{text}");
        text.replace(from, to)
    })
}

const DOCUMENTS_HTTPS: &str = r#"
  RewriteCond %{HTTP:Upgrade} websocket [NC]
  RewriteCond %{HTTP:Connection} upgrade [NC]
  RewriteRule ^/(\d*)/(.*)$ "ws://localhost:$1/$2" [P,L]
  RewriteRule ^/load$ "http://localhost:1999/load" [P,L]
  RewriteRule ^/monitor$ "http://localhost:1999/monitor" [P,L]
  RewriteRule ^/session$ "http://localhost:1999/session" [P,L]
  RewriteRule ^/(\d*)/(.*)$ "http://localhost:$1/$2" [P,L]
"#;
