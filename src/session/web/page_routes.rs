//! Routes of the session server's pages, with their assets and event streams.

use std::time::SystemTime;

use actix_web::error::ErrorInternalServerError;
use actix_web::{HttpRequest, HttpResponse, Result, web};
use askama::Template;

use super::pages::{self, Embedded, Monitor, Viewer, WebotsViewer};
use crate::asset;
use crate::session::config::AskName;
use crate::session::fleet::FleetStatus;
use crate::session::state::AppState;
use crate::shared::http::assets::{self, Asset, Content};
use crate::shared::http::routing::{GET, READ, path};
use crate::shared::http::{ConnectionKind, FOREIGN_SCRIPTS, OWN_FILES, PageView, VIEWER, framed_by, html};
use crate::shared::run::timestamp;

/// The name and the text of a file of `templates/assets`.
macro_rules! module {
    ($name:literal) => {
        ($name, include_str!(concat!("../../../templates/assets/", $name)))
    };
}

/// Assets of this server's pages, besides those that both servers share.
static ASSETS: [Asset; 6] = [
    asset!("viewer.js"),
    asset!("viewer.css"),
    asset!("class.css"),
    asset!("class.js"),
    asset!("announce.js"),
    asset!("lessons.js"),
];

/// The modules of the element `<webots-simulation>`, each after those that it imports, besides `styles.js`.
const ELEMENT_MODULES: [(&str, &str); 14] = [
    module!("dom.js"),
    module!("language.js"),
    module!("kept.js"),
    module!("turn.js"),
    module!("reasons.js"),
    module!("visit.js"),
    module!("messages.js"),
    module!("session_server.js"),
    module!("simulation_link.js"),
    module!("page_view.js"),
    module!("stage.js"),
    module!("panel.js"),
    module!("visit_runner.js"),
    module!("embed.js"),
];

/// The element for pages of other sites, and for the viewer page. The styles come with it, since links to style sheets would
/// be asked for only after it.
static ELEMENT: Asset = Asset::new("embed.js", || {
    let styles = Content::style_module(&[
        include_str!("../../../templates/assets/theme.css"),
        include_str!("../../../templates/assets/simulation.css"),
    ]);
    let modules = ELEMENT_MODULES.map(|(_, text)| text);
    let script = Content::joined(&[&[&*styles], &modules[..]].concat());
    // What it loads later is where its modules are.
    Content::of(script.replace("import('./", "import('./assets/").into())
});

/// Adds the routes to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/monitor", READ, monitor))
        .service(path("/events", GET, events))
        .service(path("/viewer", READ, viewer))
        .service(path("/webots-viewer", READ, webots_viewer))
        .service(path("/embed.js", READ, embed_script))
        .service(path("/embed.d.ts", READ, embed_types))
        .service(path("/assets/{name}", READ, asset));
}

async fn monitor(request: HttpRequest, server: web::Data<AppState>) -> Result<HttpResponse> {
    let page = async {
        let view = view(&server, &*server.status().await?).map_err(ErrorInternalServerError)?;
        let page = Monitor {
            started: timestamp(SystemTime::now() - server.started.elapsed()),
            has_actions: server.admin_auth.is_on(),
            view,
        };
        page.render().map_err(ErrorInternalServerError)
    };
    server.monitor.answer(&request, OWN_FILES, page).await
}

async fn events(request: HttpRequest, server: web::Data<AppState>) -> Result<HttpResponse> {
    let permit = server
        .connections
        .admit(ConnectionKind::Page, server.config.trusted_proxies.peer(&request))?;
    let shown = server.clone();
    let render = move || {
        let server = shown.clone();
        async move {
            let view = view(&server, &*server.status().await.ok()?);
            view.inspect_err(|error| log::error!("the monitor page can't be rendered: {error}"))
                .ok()
        }
    };
    Ok(server.live.listen(permit, server.phase.clone(), render))
}

fn view(server: &AppState, status: &FleetStatus) -> askama::Result<PageView> {
    pages::view(
        status,
        server.clients(),
        &server.client_urls,
        &server.announcement.borrow(),
    )
}

async fn viewer(request: HttpRequest, server: web::Data<AppState>) -> HttpResponse {
    let config = &server.config;
    let user = config
        .user_header
        .as_ref()
        .and_then(|header| config.trusted_proxies.user(&request, header));
    let script = server.config.viewer_script.as_ref().map(url::Url::as_str);
    if request.query_string().split('&').any(|one| one == "embed=1") {
        let policy = framed_by(VIEWER, &server.config.frame_ancestors);
        let page = Embedded {
            asks_name: user.is_none(),
            needs_name: config.ask_name == AskName::Required,
            script,
        };
        return html(page.render(), &policy);
    }
    html(
        Viewer {
            examples: &server.config.examples,
            asks_name: user.is_none(),
            needs_name: config.ask_name == AskName::Required,
            script,
        }
        .render(),
        VIEWER,
    )
}

/// Webots' own viewer is third-party code: it runs in an embedded page with an origin of its own.
async fn webots_viewer(server: web::Data<AppState>) -> HttpResponse {
    let policy = framed_by(FOREIGN_SCRIPTS, &server.config.frame_ancestors);
    html(WebotsViewer.render(), &policy)
}

async fn embed_script(request: HttpRequest) -> HttpResponse {
    ELEMENT.answer(&request)
}

/// The types of the element.
async fn embed_types() -> HttpResponse {
    HttpResponse::Ok()
        .content_type("text/plain; charset=utf-8")
        .body(include_str!("../../../templates/embed.d.ts"))
}

async fn asset(request: HttpRequest) -> HttpResponse {
    assets::answer(&request, &ASSETS)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The modules that a module imports.
    fn imported(text: &str) -> impl Iterator<Item = &str> {
        text.lines().filter_map(|line| {
            let path = line.strip_suffix("';")?.rsplit_once("'./")?;
            (path.0.starts_with("import ") || path.0.starts_with("} from ")).then_some(path.1)
        })
    }

    #[test]
    fn each_module_of_the_element_comes_after_those_that_it_imports() {
        assert_eq!(
            imported("import './a.js';\nimport {\n  b,\n} from './b.js';\n").count(),
            2
        );
        let mut before = vec!["styles.js"];
        for (name, text) in ELEMENT_MODULES {
            for module in imported(text) {
                assert!(before.contains(&module), "{name} imports {module}");
            }
            before.push(name);
        }
    }
}
