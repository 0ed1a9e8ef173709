/* SPDX-License-Identifier: MIT-0
   PFM pictures and PLY, OBJ and OFF meshes: round trips, real files, and files that mean harm. */
#include "test.h"

/* A context of one worker that counts its memory. */
static dist_context *files_context(test_allocator *a)
{
    dist_context_desc desc = test_context_desc();
    memset(a, 0, sizeof *a);
    desc.allocator = test_allocator_hook(a);
    desc.workers = 1;
    return dist_context_create(&desc);
}

static float files_bits(uint32_t bits)
{
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

static dist_mesh *files_text(dist_context *ctx, const char *text)
{
    return dist_mesh_read(ctx, text, strlen(text));
}

/* A number's bytes in the order of a little-endian file. */
static void files_little(size_t size, const void *number, unsigned char *bytes)
{
    const unsigned one = 1;
    int little = *(const unsigned char *)&one;
    for (size_t i = 0; i < size; i++) bytes[i] = ((const unsigned char *)number)[little ? i : size - 1 - i];
}

TEST(pfm_brings_back_the_same_bits_top_row_first)
{
    dist_context *ctx = test_context();
    test_random r = test_random_seed(1);
    for (int channels = 1; channels <= 3; channels += 2) {
        float pixels[5 * 3 * 3], back[5 * 3 * 3];
        unsigned char bytes[400];
        size_t n = (size_t)(15 * channels), size = 0;
        int w, h, c;
        test_random_fill(&r, n, pixels, -5, 5);
        pixels[3] = files_bits(0x7fc00000u);
        pixels[4] = files_bits(0xff800000u);
        CHECK_STATUS(DIST_OK, dist_pfm_write(ctx, 5, 3, channels, pixels, NULL, 0, &size), ctx);
        REQUIRE(size <= sizeof bytes);
        CHECK_STATUS(DIST_OK, dist_pfm_write(ctx, 5, 3, channels, pixels, bytes, size, &size), ctx);
        CHECK_BYTES(12, channels == 3 ? "PF\n5 3\n-1.0\n" : "Pf\n5 3\n-1.0\n", bytes);
        for (size_t i = 0; i < (size_t)(5 * channels); i++) {
            unsigned char expected[4];
            files_little(4, pixels + (size_t)(10 * channels) + i, expected);
            CHECK_BYTES(4, expected, bytes + 12 + 4 * i);
        }
        CHECK_STATUS(DIST_OK, dist_pfm_read(ctx, bytes, size, &w, &h, &c, NULL, 0), ctx);
        CHECK(w == 5 && h == 3 && c == channels);
        CHECK_STATUS(DIST_OK, dist_pfm_read(ctx, bytes, size, &w, &h, &c, back, n), ctx);
        CHECK_BYTES(n * 4, pixels, back);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_pfm_read(ctx, bytes, size, &w, &h, &c, back, n - 1), ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_pfm_write(ctx, 5, 3, channels, pixels, bytes, size - 1, &size), ctx);
    }
    dist_context_destroy(ctx);
}

TEST(pfm_reads_both_byte_orders_and_kinds_of_white_space)
{
    dist_context *ctx = test_context();
    static const struct {
        const char *header;
        int big;
    } cases[] = {{"Pf\n1 1\n1.0\n", 1}, {"Pf 1 1 -1 ", 0},     {"Pf\r\n1\t1\r\n-2.5e-1\r\n", 0},
                 {"Pf\n1\n1\n+3\r", 1}, {"Pf\n1 1\n-1.\n", 0}, {"Pf\n\n 01 001 \n-.5\n", 0},
                 {"Pf\n1 1\n-1.0 \n", 0}};
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        unsigned char bytes[64];
        size_t n = strlen(cases[i].header);
        static const unsigned char little[4] = {0x0a, 0x00, 0x20, 0x40}, big[4] = {0x40, 0x20, 0x00, 0x0a};
        float x = 0;
        int w, h, c;
        memcpy(bytes, cases[i].header, n);
        memcpy(bytes + n, cases[i].big ? big : little, 4);
        if (!CHECK_STATUS(DIST_OK, dist_pfm_read(ctx, bytes, n + 4, &w, &h, &c, &x, 1), ctx)) dist_context_clear(ctx);
        CHECK_NEAR(files_bits(0x4020000au), x, 0);
    }
    dist_context_destroy(ctx);
}

TEST(pfm_files_that_mean_harm_are_refused)
{
    dist_context *ctx = test_context();
    static const char *const files[] = {"",
                                        "P",
                                        "Pf",
                                        "Pf\n",
                                        "P5\n1 1\n255\naaaa",
                                        "Pf\n1 1\n-1\n",
                                        "Pf\n1 1\n-1\naaa",
                                        "Pf\n0 1\n-1\naaaa",
                                        "Pf\n-1 -1\n-1\naaaa",
                                        "Pf\n1 1\n0\naaaa",
                                        "Pf\n1 1\n-0.0\naaaa",
                                        "Pf\n1 1\nnan\naaaa",
                                        "Pf\n1 1\ninf\naaaa",
                                        "Pf\n2147483647 2147483647\n-1\naaaa",
                                        "PF\n2147483647 1431655765\n-1\naaaa",
                                        "Pf\n4294967297 1\n-1\naaaa",
                                        "Pf\n99999999999999999999 1\n-1\naaaa",
                                        "Pf\n1.5 1\n-1\naaaa",
                                        "Pf\n1 1\n-1aaaa",
                                        "Pf1 1\n-1\naaaa",
                                        "Pf\n1 1",
                                        "PF\n1 1\n1\naaaa"};
    for (size_t i = 0; i < sizeof files / sizeof files[0]; i++) {
        int w = 7, h = 7, c = 7;
        float x = 3;
        if (!CHECK_STATUS(DIST_BAD_FILE, dist_pfm_read(ctx, files[i], strlen(files[i]), &w, &h, &c, &x, 1), ctx))
            printf("    %s\n", files[i]);
        CHECK(w == 7 && h == 7 && c == 7);
        CHECK_NEAR(3, x, 0);
        dist_context_clear(ctx);
    }
    size_t size;
    float x = 1;
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_pfm_write(ctx, 0, 1, 1, &x, NULL, 0, &size), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_pfm_write(ctx, 1, 1, 2, &x, NULL, 0, &size), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_pfm_write(ctx, 1, 1, 1, &x, NULL, 0, NULL), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_pfm_write(NULL, 1, 1, 1, &x, NULL, 0, &size), NULL);
    dist_context_destroy(ctx);
}

TEST(pfm_files_are_saved_and_loaded)
{
    test_allocator a;
    dist_context *ctx = files_context(&a);
    float pixels[6] = {1, 2, 3, 4, 5, 6};
    int w = 0, h = 0, c = 0;
    const char *path = test_temp_path("test_files.pfm");
    CHECK_STATUS(DIST_OK, dist_pfm_save(ctx, path, 3, 2, 1, pixels), ctx);
    float *back = dist_pfm_load(ctx, path, &w, &h, &c);
    REQUIRE(back && w == 3 && h == 2 && c == 1);
    CHECK_BYTES(sizeof pixels, pixels, back);
    dist_pfm_free(ctx, back, w, h, c);
    dist_pfm_free(ctx, NULL, w, h, c);
    remove(path);
    CHECK(!dist_pfm_load(ctx, path, &w, &h, &c));
    CHECK_STATUS(DIST_IO, dist_context_status(ctx), ctx);
    CHECK_TEXT(path, dist_context_message(ctx));
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, a.live_blocks);
}

TEST(real_pfm_files_load)
{
    test_allocator a;
    dist_context *ctx = files_context(&a);
    const char *path = test_data_path("nets/fox.depth.pfm");
    size_t size;
    void *bytes = test_file_read(path, &size);
    if (!bytes) {
        dist_context_destroy(ctx);
        SKIP("no test data");
    }
    int w, h, c;
    float *pixels = dist_pfm_load(ctx, path, &w, &h, &c);
    if (CHECK(pixels != NULL)) {
        CHECK(w == 128 && h == 128 && c == 1);
        CHECK_BYTES(128 * 4, (unsigned char *)bytes + size - 128 * 4,
                    pixels); /* the file's last row is the picture's first */
    }
    dist_pfm_free(ctx, pixels, w, h, c);
    free(bytes);
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, a.live_blocks);
}

/* A square of two triangles and a tetrahedron's worth of floats that are hard to write. */
static dist_mesh *files_mesh(dist_context *ctx)
{
    static const uint32_t bits[18] = {0x3dcccccdu, 0x00000001u, 0x7f7fffffu, 0x80000000u, 0x3f800001u, 0xbf7fffffu,
                                      0x4b7fffffu, 0x00800000u, 0x0da24260u, 0x322bcc77u, 0x501502f9u, 0xc2f6e979u,
                                      0x49742400u, 0x3a83126fu, 0x38d1b717u, 0x3727c5acu, 0x4e6e6b28u, 0x40490fdbu};
    static const unsigned triangles[6] = {0, 1, 2, 5, 4, 3};
    float vertices[18];
    memcpy(vertices, bits, sizeof vertices);
    return dist_mesh_create(ctx, 6, vertices, 2, triangles);
}

TEST(meshes_written_and_read_again_have_the_same_bits)
{
    dist_context *ctx = test_context();
    for (int format = 0; format < 2; format++) {
        size_t size = 0, same = 0;
        dist_mesh *mesh = files_mesh(ctx);
        REQUIRE(mesh);
        CHECK_STATUS(DIST_OK, dist_mesh_write(ctx, mesh, format, NULL, 0, &size), ctx);
        void *bytes = malloc(size);
        REQUIRE(bytes);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_write(ctx, mesh, format, bytes, size - 1, &same), ctx);
        dist_context_clear(ctx);
        CHECK_STATUS(DIST_OK, dist_mesh_write(ctx, mesh, format, bytes, size, &same), ctx);
        CHECK_EQUAL(size, same);
        dist_mesh *back = dist_mesh_read(ctx, bytes, size);
        REQUIRE(back);
        CHECK_EQUAL(6, back->vertex_count);
        CHECK_EQUAL(2, back->triangle_count);
        CHECK_BYTES(72, mesh->vertices, back->vertices);
        CHECK_BYTES(24, mesh->triangles, back->triangles);
        dist_mesh_destroy(back);
        dist_mesh_destroy(mesh);
        free(bytes);
    }
    dist_context_destroy(ctx);
}

TEST(decimals_are_those_of_printf_and_bring_every_float_back)
{
    test_random r = test_random_seed(2);
    for (int i = 0; i < 200000; i++) {
        float x = files_bits((uint32_t)test_random_bits(&r));
        if (i & 1) x = (float)test_random_int(&r, -100000, 100000) / (i & 2 ? 1000.0f : 1.0f);
        unsigned char text[64];
        char expected[64];
        if (!test_finite((double)x)) continue;
        float again = 0;
        size_t size = inside_decimal(x, text), taken = inside_number(text, size, &again);
        if (!CHECK_BYTES(sizeof x, &x, &again) || !CHECK_EQUAL(size, taken)) printf("    %s\n", (const char *)text);
        snprintf(expected, sizeof expected, "%.9g", (double)x);
        if (!(i & 1) || strchr(expected, 'e')) continue; /* printf pads exponents */
        if (!CHECK(strcmp(expected, (const char *)text) == 0))
            printf("    %s is not %s\n", (const char *)text, expected);
    }
}

TEST(what_is_no_mesh_at_all_is_said_to_be_none)
{
    static const char *const files[] = {"Pf\n2 2\n-1.0\nabcdabcdabcdv v v\n", "\211PNG\r\n\032\n v 1 2\n",
                                        " \n{\"codes\":1}", "\177ELF", "OFFSET 3\nv 1 2 3\n"};
    for (size_t i = 0; i < sizeof files / sizeof files[0]; i++) {
        dist_context *ctx = test_context();
        CHECK(!dist_mesh_read(ctx, files[i], strlen(files[i])));
        CHECK_STATUS(DIST_BAD_FILE, dist_context_status(ctx), ctx);
        CHECK_TEXT("this is no PLY, OBJ or OFF file", dist_context_message(ctx));
        dist_context_destroy(ctx);
    }
}

TEST(normals_are_written_to_both_formats)
{
    dist_context *ctx = test_context();
    float numbers[4] = {0, 0, 0, 1};
    dist_field field = dist_field_sphere(numbers);
    dist_mesh_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.resolution = 8;
    desc.normals = 1;
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh);
    for (int format = 0; format < 2; format++) {
        size_t size = 0;
        dist_mesh_write(ctx, mesh, format, NULL, 0, &size);
        char *bytes = (char *)malloc(size + 1);
        REQUIRE(bytes);
        CHECK_STATUS(DIST_OK, dist_mesh_write(ctx, mesh, format, bytes, size, &size), ctx);
        bytes[size] = 0;
        if (format == DIST_MESH_PLY) CHECK_TEXT("property float nz\n", bytes);
        if (format == DIST_MESH_OBJ) CHECK(strstr(bytes, "\nvn ") && strstr(bytes, "//"));
        dist_mesh *back = dist_mesh_read(ctx, bytes, size);
        REQUIRE(back);
        CHECK_BYTES(mesh->vertex_count * 12, mesh->vertices, back->vertices);
        CHECK_BYTES(mesh->triangle_count * 12, mesh->triangles, back->triangles);
        dist_mesh_destroy(back);
        free(bytes);
    }
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

static const char *const good_files[] = {
    "ply\nformat ascii 1.0\ncomment x\nelement vertex 4\nproperty float x\nproperty float y\nproperty double z\n"
    "property float quality\nelement face 1\nproperty list uchar int vertex_indices\nproperty uchar flag\nelement edge "
    "1\n"
    "property int a\nend_header\n0 0 0 nan\n1 0 0 1\n1 1 0 1\n0 1 0 1\n4 0 1 2 3 9\n5\n",
    "ply\r\nformat ascii 1.0\r\nelement vertex 4\r\nproperty float32 y\r\nproperty float32 x\r\nproperty float32 "
    "z\r\nelement void "
    "99999999999\r\nelement face 2\r\nproperty list uint8 uint32 vertex_index\r\nend_header\r\n0 0 0\r\n0 1 0\r\n1 1 "
    "0\r\n1 0 0\r\n"
    "3 0 1 2\r\n3 0 2 3",
    "OFF\n4 1 4\n0 0 0\n1 0 0\n\n# comment\n1 1 0 # more\n0 1 0\n4 0 1 2 3 255 0 0\n",
    "OFF 4 2 0\r\n0 0 0\r\n1 0 0\r\n1 1 0\r\n0 1 0\r\n3 0 1 2\r\n3 0 2 3\r\n",
    "OFF4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "\n# by hand\n\n# twice\nOFF\n4 2\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "STOFF 4 2 0\n0 0 0 .5 .5\n1 0 0 1 .5\n1 1 0 1 1\n0 1 0 .5 1\n3 0 1 2\n3 0 2 3\n",
    "OFF\n4 # vertices\n2\n5 # edges\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "OFF\n4 2\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
    "COFF\n4 1 0\n0 0 0 1 1 1 1\n1 0 0 1 1 1 1\n1 1 0 1 1 1 1\n0 1 0 1 1 1 1\n4 0 1 2 3\n",
    "# obj\nmtllib a.mtl\nv 0 0 0\nv 1. 0 0 1.0\nvt 0 0\nvn 0 0 1\nv 1 1e0 -0.0\nv .0 +1 0\nusemtl a\nf 1/1/1 2//1 3/1 "
    "4\n",
    "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1 4\nv 0 1 0",
    "v 0 0 \\\n0\nv 1 0 0\nv \\\r\n1 1\\\n 0\nv 0 1 0\nf 1 2/2\\\n 3 \\\r\\\r4\\\n\n",
    "f 1 2 3\nf 1 3 4\nf 1 2\nf\n  v 0 0 0\n\tv\t1\t0\t0\r\nv 1 1 0 0.5 0.5 0.5\nv 0 1 0 # end\n",
    "v 0 0 0# one\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3# one\nf 1/1 3/2 4/3# two\n"};
enum { GOOD_FILES = sizeof good_files / sizeof good_files[0] };

TEST(every_dialect_reads_as_the_same_square)
{
    dist_context *ctx = test_context();
    static const float square[12] = {0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0};
    static const unsigned triangles[6] = {0, 1, 2, 0, 2, 3};
    for (int i = 0; i < GOOD_FILES; i++) {
        dist_mesh *mesh = files_text(ctx, good_files[i]);
        if (!CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx)) printf("    file %d\n", i);
        dist_context_clear(ctx);
        if (!mesh) continue;
        CHECK_EQUAL(4, mesh->vertex_count);
        CHECK_EQUAL(2, mesh->triangle_count);
        if (mesh->vertex_count == 4) CHECK_NEAR_ARRAY(12, square, mesh->vertices, 0);
        if (mesh->triangle_count == 2) CHECK_BYTES(sizeof triangles, triangles, mesh->triangles);
        dist_mesh_destroy(mesh);
    }
    dist_context_destroy(ctx);
}

/* The bytes of one number, which stand as in a little-endian file, as they stand in a big-endian one. */
static void files_turn(int big, size_t n, unsigned char *bytes)
{
    for (size_t i = 0; big && i < n / 2; i++) {
        unsigned char keep = bytes[i];
        bytes[i] = bytes[n - 1 - i];
        bytes[n - 1 - i] = keep;
    }
}

TEST(binary_ply_of_mixed_types_and_either_order_is_read)
{
    for (int big = 0; big < 2; big++) {
        dist_context *ctx = test_context();
        char header[256];
        (void)snprintf(header, sizeof header,
                       "ply\nformat binary_%s_endian 1.0\nelement vertex 3\nproperty short skip\nproperty double x\n"
                       "property float y\nproperty double z\nelement face 1\nproperty list ushort short "
                       "vertex_indices\nend_header\n", big ? "big" : "little");
        unsigned char bytes[sizeof header + 200];
        size_t n = strlen(header);
        memcpy(bytes, header, n);
        for (int i = 0; i < 3; i++) {
            double x = 1.5 * i, z = -i;
            float y = 0.25f * (float)(i * i);
            memset(bytes + n, 0xff, 2);
            files_little(8, &x, bytes + n + 2);
            files_little(4, &y, bytes + n + 10);
            files_little(8, &z, bytes + n + 14);
            files_turn(big, 8, bytes + n + 2);
            files_turn(big, 4, bytes + n + 10);
            files_turn(big, 8, bytes + n + 14);
            n += 22;
        }
        static const unsigned char face[8] = {3, 0, 2, 0, 1, 0, 0, 0};
        memcpy(bytes + n, face, 8);
        for (size_t i = 0; i < 8; i += 2) files_turn(big, 2, bytes + n + i);
        dist_mesh *mesh = dist_mesh_read(ctx, bytes, n + 8);
        if (CHECK(mesh != NULL)) {
            CHECK(mesh->triangles[0] == 2 && mesh->triangles[1] == 1 && mesh->triangles[2] == 0);
            CHECK_NEAR(3, mesh->vertices[6], 0);
            CHECK_NEAR(1, mesh->vertices[7], 0);
            CHECK_NEAR(-2, mesh->vertices[8], 0);
        }
        dist_mesh_destroy(mesh);
        bytes[n + (big ? 2 : 3)] = 0xff; /* index -254 */
        CHECK(!dist_mesh_read(ctx, bytes, n + 8));
        CHECK_STATUS(DIST_BAD_FILE, dist_context_status(ctx), ctx);
        dist_context_clear(ctx);
        for (size_t cut = 0; cut < n + 8; cut++) {
            CHECK(!dist_mesh_read(ctx, bytes, cut));
            dist_context_clear(ctx);
        }
        dist_context_destroy(ctx);
    }
}

#define PLY "ply\nformat ascii 1.0\n"
#define XYZ "property float x\nproperty float y\nproperty float z\n"

TEST(lines_end_as_they_like_and_a_mark_of_utf8_is_no_vertex)
{
    static const char *const files[] = {
        "v 0 0 0\rv 1 0 0\rv 0 1 0\rf 1 2 3\r",
        "v 0 0 0\r\nv 1 0 0\r\nv 0 1 0\r\nf 1 2 3\r\n",
        "\357\273\277v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "\357\273\277OFF\r3 1 0\r0 0 0\r1 0 0\r0 1 0\r3 0 1 2\r",
        "ply\rformat ascii 1.0\relement vertex 3\rproperty float x\rproperty float y\rproperty float z\r"
        "element face 1\rproperty list uchar int vertex_index\rend_header\r0 0 0\r1 0 0\r0 1 0\r3 0 1 2\r"};
    dist_context *ctx = test_context();
    for (size_t i = 0; i < sizeof files / sizeof files[0]; i++) {
        dist_mesh *mesh = dist_mesh_read(ctx, files[i], strlen(files[i]));
        REQUIRE(mesh != NULL);
        CHECK_EQUAL(3, mesh->vertex_count);
        CHECK_EQUAL(1, mesh->triangle_count);
        CHECK_NEAR(1, mesh->vertices[3], 0);
        dist_mesh_destroy(mesh);
    }
    dist_context_destroy(ctx);
}

TEST(mesh_files_that_mean_harm_are_refused_with_a_sentence)
{
    dist_context *ctx = test_context();
    static const char *const files[] = {
        "",
        "\n",
        "ply",
        "ply\n",
        "\357\273\277",
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
        "OFF",
        "OFF\n",
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element tristrips 1\nproperty list int int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n"
        "4 0 1 2 3\n",
        "OFF BINARY\n",
        "OFF\n1 1 0\n0 0 0\n",
        "OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 3\n",
        "OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 -1\n",
        "OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 1.5\n",
        "OFF\n1 0 0\nnan 0 0\n",
        "OFF\n1 0 0\n1e39 0 0\n",
        "OFF\n1 0 0\n1e999 0 0\n",
        "OFF\n99999999999999 1 0\n1 2 3\n",
        "OFF\n1 99999999999999 0\n1 2 3\n",
        "OFF\n1 1 0\n1 2 3\n1e300 0 0 0\n",
        "OFF\n-3 -1 0\n",
        "OFF\n2.5 0 0\n0 0 0\n0 0 0\n0 0 0\n",
        "OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n-3 0 1 2\n",
        "OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n2.5 0 1 2\n",
        "v 0 0\n",
        "v 0 0 x\n",
        "v 0 0 0abc\n",
        "v 0 0.5.5 0\n",
        "v 1..2 0 0\n",
        "v 1.2.3 0 0\n",
        "v inf 0 0\n",
        "v nan 0 0\n",
        "v 0 0 0\nf 1 1 2\n",
        "v 0 0 0\nf 1 1 0\n",
        "v 0 0 0\nf -1 -1 -2\n",
        "v 0 0 0\nf a b c\n",
        "v 0 0 0\nf 1 1 99999999999999999999\n",
        "v 0 0 0\nf 1 1 1.5\n",
        "just text",
        "v 0 0 0\nf 1 1 4294967297\n",
        PLY "element vertex 1\n" XYZ,
        "ply\nelement vertex 1\n" XYZ "end_header\n0 0 0\n",
        PLY "element vertex 1\n" XYZ "end_header\n0 0\n",
        PLY "element vertex 1\nproperty float x\nend_header\n0\n",
        PLY "element vertex -1\n" XYZ "end_header\n",
        PLY "element vertex x\n" XYZ "end_header\n",
        PLY "property float x\nend_header\n",
        PLY "element vertex 1\nproperty blob x\n",
        PLY "element vertex 1\n" XYZ "property list float int vertex_indices\nend_header\n",
        PLY "element vertex 1\n" XYZ
            "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 0 1\n",
        PLY "element vertex 1\n" XYZ
            "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n4000000000 0 0 0\n",
        PLY "element vertex 1\n" XYZ
            "element face 1\nproperty list int int vertex_indices\nend_header\n0 0 0\n-3 0 0 0\n",
        PLY "element vertex 4000000000\n" XYZ "end_header\n0 0 0\n",
        PLY "element vertex 99999999999999999999\n" XYZ "end_header\n",
        "ply\nformat binary_middle_endian 1.0\nelement vertex 0\n" XYZ "end_header\n",
        "ply\nformat binary_big_endian 1.0\nelement vertex 2\n" XYZ "end_header\n0123456789ab",
        "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n" XYZ "end_header\n0123456789ab"};
    for (size_t i = 0; i < sizeof files / sizeof files[0]; i++) {
        dist_mesh *mesh = files_text(ctx, files[i]);
        if (!CHECK(mesh == NULL)) printf("    %s\n", files[i]);
        CHECK_TEXT("dist_mesh_read", dist_context_message(ctx));
        CHECK(dist_context_status(ctx) != DIST_OK && dist_context_status(ctx) != DIST_OUT_OF_MEMORY);
        dist_mesh_destroy(mesh);
        dist_context_clear(ctx);
    }
    CHECK(!dist_mesh_read(ctx, NULL, 5));
    CHECK(!dist_mesh_read(NULL, "v", 1));
    dist_context_destroy(ctx);
}

TEST(what_a_mesh_file_has_wrong_is_told_as_the_file_counts)
{
    dist_context *ctx = test_context();
    static const char *const files[][2] = {
        {"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "a face has vertex 4, must be 1 to 3"},
        {"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "byte 27: a face has vertex 0, must count from 1"},
        {"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n", "a face has vertex -4, must count from 1"},
        {"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 1 2 3\n", "a face has vertex 3, must be below 3"}};
    for (size_t i = 0; i < sizeof files / sizeof files[0]; i++) {
        CHECK(files_text(ctx, files[i][0]) == NULL);
        CHECK_STATUS(DIST_BAD_FILE, dist_context_status(ctx), ctx);
        CHECK_TEXT(files[i][1], dist_context_message(ctx));
        dist_context_clear(ctx);
    }
    char many[1024] = "ply\nformat ascii 1.0\n";
    for (int i = 0; i < 17; i++) strcat(many, "element more 0\nproperty int a\n");
    strcat(many, "end_header\n");
    CHECK(files_text(ctx, many) == NULL);
    CHECK_STATUS(DIST_UNSUPPORTED, dist_context_status(ctx), ctx);
    CHECK_TEXT("more than 16 PLY elements", dist_context_message(ctx));
    dist_context_destroy(ctx);
}

/* Bytes changed, cut out, doubled, or taken from elsewhere in the file. */
static size_t files_mutate(test_random *r, unsigned char *bytes, size_t n)
{
    static const char spice[] = "0123456789-+.eE \n\tvf/\\#plyOFF\xff\x80\x7f";
    int changes = test_random_int(r, 1, 4);
    for (int i = 0; i < changes && n > 2; i++) {
        size_t at = (size_t)test_random_int(r, 0, (int)n - 1), from = (size_t)test_random_int(r, 0, (int)n - 1);
        size_t length = (size_t)test_random_int(r, 1, 12), room = n - (at > from ? at : from);
        if (length > room) length = room;
        switch (test_random_int(r, 0, 4)) {
        case 0: bytes[at] = (unsigned char)test_random_bits(r); break;
        case 1: bytes[at] = (unsigned char)spice[test_random_int(r, 0, (int)sizeof spice - 2)]; break;
        case 2: memmove(bytes + at, bytes + from, length); break;
        case 3:
            memmove(bytes + at, bytes + at + length, n - at - length);
            n -= length;
            break;
        default:
            if (test_random_int(r, 0, 3) == 0) n = at;
            break;
        }
    }
    return n;
}

/* One mutated file in memory of exactly its size, so that a sanitizer sees a read beyond it. */
static void files_try(dist_context *ctx, test_allocator *a, const void *original, size_t n, uint64_t seed, int pfm)
{
    test_random r = test_random_seed(seed);
    unsigned char *work = (unsigned char *)malloc(n + 1);
    if (!CHECK(ctx && work)) return;
    memcpy(work, original, n);
    n = files_mutate(&r, work, n);
    unsigned char *exact = (unsigned char *)malloc(n ? n : 1);
    if (!CHECK(exact != NULL)) return;
    memcpy(exact, work, n);
    size_t before = a->live_bytes;
    a->peak_bytes = before;
    dist_context_clear(ctx);
    if (pfm) {
        int w, h, c;
        float pixels[64];
        dist_pfm_read(ctx, exact, n, &w, &h, &c, pixels, 64);
    } else {
        dist_mesh *mesh = dist_mesh_read(ctx, exact, n);
        if (!mesh) CHECK(dist_context_status(ctx) != DIST_OK);
        for (size_t i = 0; mesh && i < 3 * mesh->triangle_count; i++) CHECK(mesh->triangles[i] < mesh->vertex_count);
        if (mesh) CHECK(test_finite_all(3 * mesh->vertex_count, mesh->vertices));
        dist_mesh_destroy(mesh);
    }
    CHECK(a->peak_bytes - before <= 40 * n + 8192);
    CHECK_EQUAL(before, a->live_bytes);
    free(exact);
    free(work);
}

TEST(mutated_meshes_never_crash_leak_or_take_much_memory)
{
    uint64_t seed = 100;
    int rounds = test_quick() ? 200 : 2000;
    test_allocator a;
    dist_context *ctx = files_context(&a);
    for (int file = 0; file < GOOD_FILES; file++)
        for (int i = 0; i < rounds; i++) files_try(ctx, &a, good_files[file], strlen(good_files[file]), seed++, 0);
    dist_context_clear(ctx);
    dist_mesh *mesh = files_mesh(ctx);
    REQUIRE(mesh);
    for (int format = 0; format < 2; format++) {
        unsigned char bytes[2000];
        size_t size = 0;
        CHECK_STATUS(DIST_OK, dist_mesh_write(ctx, mesh, format, bytes, sizeof bytes, &size), ctx);
        for (int i = 0; i < rounds; i++) files_try(ctx, &a, bytes, size, seed++, 0);
    }
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

TEST(mutated_pictures_never_crash)
{
    test_allocator a;
    dist_context *ctx = files_context(&a);
    float pixels[12] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11};
    unsigned char bytes[100];
    size_t size = 0;
    CHECK_STATUS(DIST_OK, dist_pfm_write(ctx, 2, 2, 3, pixels, bytes, sizeof bytes, &size), ctx);
    for (int i = 0; i < (test_quick() ? 500 : 5000); i++) files_try(ctx, &a, bytes, size, 9000u + (uint64_t)i, 1);
    dist_context_destroy(ctx);
}

TEST(meshes_are_saved_by_their_ending_and_loaded)
{
    test_allocator a;
    dist_context *ctx = files_context(&a);
    dist_mesh *mesh = files_mesh(ctx);
    REQUIRE(mesh);
    static const char *const names[2] = {"test_files.ply", "test_files.OBJ"};
    for (int i = 0; i < 2; i++) {
        const char *path = test_temp_path(names[i]);
        CHECK_STATUS(DIST_OK, dist_mesh_save(ctx, mesh, path), ctx);
        dist_mesh *back = dist_mesh_load(ctx, path);
        REQUIRE(back);
        CHECK_BYTES(72, mesh->vertices, back->vertices);
        dist_mesh_destroy(back);
        remove(path);
    }
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_save(ctx, mesh, test_temp_path("test_files.stl")), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_save(ctx, mesh, "ly"), ctx);
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_save(ctx, mesh, ""), ctx);
    CHECK_TEXT("dist_mesh_save: path is '', must end in .ply or .obj", dist_context_message(ctx));
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_save(ctx, mesh, NULL), ctx);
    CHECK_STATUS(DIST_IO, dist_mesh_save(ctx, mesh, "/no such folder/a.ply"), ctx);
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, a.live_blocks);
    CHECK_EQUAL(0, a.errors);
}

TEST(folders_empty_and_missing_files_are_sentences_with_the_path)
{
    dist_context *ctx = test_context();
    const char *path = test_temp_path("test_files_empty.obj");
    CHECK(!dist_mesh_load(ctx, path));
    CHECK_TEXT("test_files_empty.obj", dist_context_message(ctx));
    CHECK_STATUS(DIST_IO, dist_context_status(ctx), ctx);
    dist_context_clear(ctx);
    FILE *file = fopen(path, "wb");
    REQUIRE(file);
    fclose(file);
    CHECK(!dist_mesh_load(ctx, path));
    CHECK_TEXT("test_files_empty.obj", dist_context_message(ctx));
    dist_context_clear(ctx);
    remove(path);
    CHECK(!dist_net_load_file(ctx, path));
    CHECK_TEXT("dist_net_load_file: the file cannot be opened (", dist_context_message(ctx));
    CHECK_TEXT("test_files_empty.obj)", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK(!dist_net_load_file(ctx, "dist.h")); /* what is wrong inside is told with the path, too */
    CHECK_TEXT("dist_net_load: the file has a header length", dist_context_message(ctx));
    CHECK_TEXT("(dist.h)", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK(!dist_net_load(ctx, "rubbish", 7)); /* and not where there is none */
    CHECK(!strstr(dist_context_message(ctx), "dist.h"));
    dist_context_clear(ctx);
    const float pixel = 1.0f;
    CHECK_STATUS(DIST_IO, dist_pfm_save(ctx, "tests", 1, 1, 1, &pixel), ctx);
    CHECK_TEXT("dist_pfm_save: the file cannot be opened for writing (tests)", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK(!dist_mesh_load(ctx, "tests"));
    CHECK_STATUS(DIST_IO, dist_context_status(ctx), ctx);
    CHECK_TEXT("tests", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK(!dist_mesh_load(ctx, NULL));
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_context_status(ctx), ctx);
    dist_context_destroy(ctx);
}

TEST(real_meshes_load_with_the_counts_of_their_files)
{
    static const struct {
        const char *name;
        size_t vertices, triangles;
    } files[] = {{"meshes/bunny_igl.off", 3485, 6966},
                 {"meshes/fertility.off", 4494, 9000},
                 {"meshes/fandisk.obj", 6475, 12946},
                 {"meshes/spot.obj", 2930, 5856},
                 {"meshes/chair_mesh_to_sdf.obj", 2830, 5660}};
    FILE *file = fopen(test_data_path(files[0].name), "rb");
    if (!file) SKIP("no test data");
    fclose(file);
    dist_context *ctx = test_context();
    for (size_t i = 0; i < sizeof files / sizeof files[0]; i++) {
        dist_mesh *mesh = dist_mesh_load(ctx, test_data_path(files[i].name));
        CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
        REQUIRE(mesh);
        CHECK_EQUAL(files[i].vertices, mesh->vertex_count);
        CHECK_EQUAL(files[i].triangles, mesh->triangle_count);
        dist_mesh_destroy(mesh);
    }
    dist_context_destroy(ctx);
}

TEST(out_of_memory_names_the_function_that_saves)
{
    test_allocator a;
    dist_context *ctx = files_context(&a);
    dist_mesh *mesh = files_mesh(ctx);
    dist_net *net = dist_net_load_file(ctx, "examples/model.safetensors");
    const float pixels[4] = {1, 2, 3, 4};
    REQUIRE(mesh && net);
    a.fail_at = a.requests + 1;
    a.fail_onwards = 1;
    CHECK_EQUAL(DIST_OUT_OF_MEMORY, dist_mesh_save(ctx, mesh, test_temp_path("test_files_none.ply")));
    CHECK_TEXT("dist_mesh_save: out of memory", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_EQUAL(DIST_OUT_OF_MEMORY, dist_pfm_save(ctx, test_temp_path("test_files_none.pfm"), 2, 2, 1, pixels));
    CHECK_TEXT("dist_pfm_save: out of memory", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_EQUAL(DIST_OUT_OF_MEMORY, dist_net_save_file(ctx, net, test_temp_path("test_files_none.safetensors")));
    CHECK_TEXT("dist_net_save_file: out of memory", dist_context_message(ctx));
    dist_net_destroy(net);
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, a.live_blocks);
}

TEST(every_allocation_of_reading_and_saving_may_fail)
{
    const char *path = test_temp_path("test_files_failing.obj");
    int done = 0;
    for (size_t n = 1; !done && n < 50; n++) {
        test_allocator a;
        dist_context *ctx = files_context(&a);
        REQUIRE(ctx);
        dist_mesh *back = NULL;
        float pixels[4] = {1, 2, 3, 4}, *picture = NULL;
        int w = 0, h = 0, c = 0;
        a.fail_at = a.requests + n;
        dist_mesh *mesh = files_text(ctx, good_files[n % GOOD_FILES]);
        if (mesh && dist_mesh_save(ctx, mesh, path) == DIST_OK) back = dist_mesh_load(ctx, path);
        if (back && dist_pfm_save(ctx, path, 2, 2, 1, pixels) == DIST_OK)
            picture = dist_pfm_load(ctx, path, &w, &h, &c);
        done = picture != NULL;
        if (!done) CHECK_STATUS(DIST_OUT_OF_MEMORY, dist_context_status(ctx), ctx);
        dist_pfm_free(ctx, picture, w, h, c);
        dist_mesh_destroy(back);
        dist_mesh_destroy(mesh);
        dist_context_destroy(ctx);
        CHECK_EQUAL(0, a.live_blocks);
        CHECK_EQUAL(0, a.errors);
    }
    CHECK(done);
    remove(path);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(pfm_brings_back_the_same_bits_top_row_first);
    RUN(pfm_reads_both_byte_orders_and_kinds_of_white_space);
    RUN(pfm_files_that_mean_harm_are_refused);
    RUN(pfm_files_are_saved_and_loaded);
    RUN(real_pfm_files_load);
    RUN(meshes_written_and_read_again_have_the_same_bits);
    RUN(decimals_are_those_of_printf_and_bring_every_float_back);
    RUN(what_is_no_mesh_at_all_is_said_to_be_none);
    RUN(normals_are_written_to_both_formats);
    RUN(every_dialect_reads_as_the_same_square);
    RUN(what_a_mesh_file_has_wrong_is_told_as_the_file_counts);
    RUN(binary_ply_of_mixed_types_and_either_order_is_read);
    RUN(lines_end_as_they_like_and_a_mark_of_utf8_is_no_vertex);
    RUN(mesh_files_that_mean_harm_are_refused_with_a_sentence);
    RUN(mutated_meshes_never_crash_leak_or_take_much_memory);
    RUN(mutated_pictures_never_crash);
    RUN(meshes_are_saved_by_their_ending_and_loaded);
    RUN(folders_empty_and_missing_files_are_sentences_with_the_path);
    RUN(real_meshes_load_with_the_counts_of_their_files);
    RUN(out_of_memory_names_the_function_that_saves);
    RUN(every_allocation_of_reading_and_saving_may_fail);
    return test_report();
}
