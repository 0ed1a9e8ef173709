/* SPDX-License-Identifier: MIT-0
   plot_csv.c - a benchmark's CSV as a picture: one line for each of its rows, one panel for each of some columns. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#define COMMON_NO_MODEL
#include "../examples/common.h"
#include "bench.h"
#include "plot.h"

static const char usage[] =
    "plot_csv FILE.csv FILE.svg [options]\n"
    "  --title TEXT\n"
    "  --subtitle TEXT\n"
    "  --rows COLUMN,..   what names a line of the plot, together\n"
    "  --series COLUMN,.. what tells the markers of one line apart, together\n"
    "  --panel COLUMN[:log][:GUIDE:WORD]  a panel of this column; at most six\n"
    "  --only COLUMN=VALUE  only rows of the CSV that are so\n"
    "  --open COLUMN:LIMIT  markers are open where this is more\n"
    "  --open-means TEXT\n"
    "  --note TEXT        under the legend\n"
    "  --columns N        panels side by side (default 3)\n"
    "Lines of the CSV that begin with # are left out; the first other one names the columns.\n";

enum { PANELS = 6, COLUMNS = 64, LINE = 4096, LIST = 8 };

typedef struct wish {
    char text[256];
    char *parts[LIST]; /* of text, cut at the separator */
    int n;
} wish;

static void wish_set(wish *w, const char *text, char separator)
{
    if (strlen(text) >= sizeof w->text) { fail("too long: %s", text); }
    strcpy(w->text, text);
    w->n = 0;
    for (char *at = w->text; at && w->n < LIST;) {
        w->parts[w->n++] = at;
        at = strchr(at, separator);
        if (at) { *at++ = 0; }
    }
}

typedef struct csv {
    FILE *file;
    char head[LINE], line[LINE];
    char *names[COLUMNS], *cells[COLUMNS];
    int columns;
} csv;

/* Cuts a line at its commas; returns how many cells it has. No cell of the benchmarks holds a comma or quotes. */
static int split(char *line, char *cells[COLUMNS])
{
    int n = 0;
    line[strcspn(line, "\r\n")] = 0;
    for (char *at = line; at && n < COLUMNS;) {
        cells[n++] = at;
        at = strchr(at, ',');
        if (at) { *at++ = 0; }
    }
    return n;
}

/* The next row into cells; 0 at the end. */
static int csv_next(csv *c)
{
    while (fgets(c->line, sizeof c->line, c->file)) {
        if (c->line[0] == '#' || c->line[0] == '\n') { continue; }
        if (split(c->line, c->cells) == c->columns) { return 1; }
    }
    return 0;
}

static int csv_column(const csv *c, const char *name)
{
    for (int i = 0; i < c->columns; i++) {
        if (strcmp(c->names[i], name) == 0) { return i; }
    }
    fail("no column is called %s", name);
}

static void csv_open(csv *c, const char *path)
{
    c->file = open_file(path, "rb");
    do {
        if (!fgets(c->head, sizeof c->head, c->file)) { fail("%s has no header", path); }
    } while (c->head[0] == '#');
    c->columns = split(c->head, c->names);
}

/* The cells of those columns with a comma between, kept for good; the same text is the same pointer. */
static const char *joined(const csv *c, const wish *columns)
{
    static char kept[512][96];
    static int used;
    char text[96] = "";
    for (int i = 0; i < columns->n; i++) {
        size_t length = strlen(text);
        snprintf(text + length, sizeof text - length, "%s%s", i ? ", " : "",
                 c->cells[csv_column(c, columns->parts[i])]);
    }
    for (int i = 0; i < used; i++) {
        if (strcmp(kept[i], text) == 0) { return kept[i]; }
    }
    if (used == 512) { fail("more than 512 names"); }
    memcpy(kept[used], text, sizeof text);
    return kept[used++];
}

static int has_part(const wish *w, const char *word)
{
    for (int i = 1; i < w->n; i++) {
        if (strcmp(w->parts[i], word) == 0) { return 1; }
    }
    return 0;
}

int main(int argc, char **argv)
{
    const char *paths[2] = {NULL, NULL}, *title = "", *subtitle = NULL, *means = NULL;
    char words[PANELS][96];
    wish rows, series, only, open, panels[PANELS];
    int columns = 3, n = 0, path_count = 0, note_count = 0;
    const char *notes[4];
    memset(&rows, 0, sizeof rows);
    series = only = open = rows;
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--title")) {
            title = option_text(&o);
        } else if (option_is(&o, "--subtitle")) {
            subtitle = option_text(&o);
        } else if (option_is(&o, "--rows")) {
            wish_set(&rows, option_text(&o), ',');
        } else if (option_is(&o, "--series")) {
            wish_set(&series, option_text(&o), ',');
        } else if (option_is(&o, "--panel") && n < PANELS) {
            wish_set(&panels[n++], option_text(&o), ':');
        } else if (option_is(&o, "--only")) {
            wish_set(&only, option_text(&o), '=');
        } else if (option_is(&o, "--open")) {
            wish_set(&open, option_text(&o), ':');
        } else if (option_is(&o, "--open-means")) {
            means = option_text(&o);
        } else if (option_is(&o, "--note") && note_count < 4) {
            notes[note_count++] = option_text(&o);
        } else if (option_is(&o, "--columns")) {
            columns = option_int(&o, 1, PANELS);
        } else if (option_is_word(&o) && path_count < 2) {
            paths[path_count++] = argv[o.index];
        } else {
            option_unknown(&o);
        }
    }
    if (path_count < 2 || !n || !rows.n) { fail("plot_csv needs two files, --rows and a --panel; see --help"); }
    if ((only.n && only.n != 2) || (open.n && open.n != 2)) { fail("--only COLUMN=VALUE, --open COLUMN:LIMIT"); }
    csv c;
    csv_open(&c, paths[0]);
    plot p = plot_begin(title, subtitle, columns);
    for (int k = 0; k < n; k++) {
        size_t i = 0;
        for (; panels[k].parts[0][i] && i + 1 < sizeof words[k]; i++) { /* a column's name as words */
            words[k][i] = panels[k].parts[0][i] == '_' ? ' ' : panels[k].parts[0][i];
        }
        words[k][i] = 0;
        plot_panel *a = plot_add_panel(&p, words[k], NULL, NULL, has_part(&panels[k], "log") ? PLOT_LOG_X : 0);
        int at = 1 + has_part(&panels[k], "log");
        if (panels[k].n >= at + 2) {
            a->guide = atof(panels[k].parts[at]);
            a->guide_text = panels[k].parts[at + 1];
        }
    }
    int lines = 0;
    while (csv_next(&c)) {
        if (only.n && strcmp(c.cells[csv_column(&c, only.parts[0])], only.parts[1]) != 0) { continue; }
        const char *row = joined(&c, &rows);
        const char *name = series.n ? joined(&c, &series) : "";
        int failed = open.n && atof(c.cells[csv_column(&c, open.parts[0])]) > atof(open.parts[1]);
        for (int k = 0; k < n; k++) {
            const char *cell = c.cells[csv_column(&c, panels[k].parts[0])];
            double y = plot_category(&p.panels[k], row);
            lines = lines > p.panels[k].category_count ? lines : p.panels[k].category_count;
            plot_series *s = plot_series_of(&p.panels[k], name);
            s->no_line = 1;
            s->hidden = !series.n;
            if (*cell) { plot_add(s, atof(cell), y)->open = failed; }
        }
    }
    fclose(c.file);
    if (!lines) { fail("%s has no rows to show", paths[0]); }
    p.panel_height = fmax(60, 19.0 * lines);
    p.open_means = means;
    for (int i = 0; i < note_count; i++) { p.notes[i] = notes[i]; }
    plot_write(&p, paths[1], bench_origin());
    return 0;
}
